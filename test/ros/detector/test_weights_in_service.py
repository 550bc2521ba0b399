"""Weights files as the running node meets them: each bad one refused, in activate and in a swap."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from support.random_model import TINY, random_model, random_network
from support.served_node import ServedNode
from support.worker import worker_domain

from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.detection.prepared_model import prepare_model
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.settings.settings import SETTINGS

Spoil = Callable[[Path, Path], object]


def _cut_short(good: Path, bad: Path) -> None:
    data = good.read_bytes()
    bad.write_bytes(data[: len(data) // 2])


BAD_FILES = [
    pytest.param(lambda good, bad: None, "bad.safetensors", "no such file", id="missing"),
    pytest.param(lambda good, bad: bad.write_bytes(b""), "bad.safetensors", "0 bytes", id="empty"),
    pytest.param(lambda good, bad: bad.mkdir(), "bad.safetensors", "regular file", id="folder"),
    pytest.param(
        lambda good, bad: os.mkfifo(bad), "bad.pt", "regular file", id="pipe", marks=pytest.mark.long
    ),
    pytest.param(_cut_short, "bad.safetensors", "cut short", id="truncated", marks=pytest.mark.long),
    pytest.param(
        lambda good, bad: bad.write_bytes(good.read_bytes()),
        "bad.engine",
        "ends in",
        id="wrong-suffix",
        marks=pytest.mark.long,
    ),
    pytest.param(lambda good, bad: bad.write_bytes(b"<!DOCTYPE html>"), "bad.pt", "HTML page", id="html"),
]


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "good.safetensors"
    write_safetensors(random_model(), path)
    return path


@pytest.fixture
def served(ros_domain: int, good: Path) -> Iterator[ServedNode]:
    with ServedNode(prepare_model, parameters=[f"weights:={good}", "image_size:=64"]) as served:
        yield served
    assert served.escaped == []


@pytest.mark.parametrize(("spoil", "name", "message"), BAD_FILES)
def test_a_bad_file_is_refused_by_activate_and_by_a_swap(
    served: ServedNode, good: Path, spoil: Spoil, name: str, message: str
) -> None:
    bad = good.with_name(name)
    spoil(good, bad)
    assert served.set(weights=str(bad)) == (True, "")
    served.bring_to("inactive")
    assert not served.transition("activate")
    told = served.status().message
    assert str(bad) in told
    assert message in told
    assert served.set(weights=str(good)) == (True, "")
    assert served.transition("activate")
    done, reason = served.set(weights=str(bad))
    assert not done
    assert str(bad) in reason
    assert message in reason
    assert served.get("weights") == str(good)
    assert served.detect().header.stamp.sec > 0


@pytest.mark.long
def test_a_wrong_digest_is_refused_with_both_digests(served: ServedNode) -> None:
    served.bring_to("active")
    digest = served.values()["sha256"]
    done, reason = served.set(weights_sha256="0" * 64)
    assert not done
    assert digest in reason
    assert "0" * 64 in reason
    assert served.set(weights_sha256=digest) == (True, "")


@pytest.mark.long
def test_a_swap_to_a_model_without_a_filtered_class_is_explained(served: ServedNode, good: Path) -> None:
    other = good.with_name("other.safetensors")
    fruit = dataclasses.replace(TINY, classes=2)
    write_safetensors(Model(fruit, ("apple", "pear"), random_network(1, fruit).state_dict()), other)
    served.bring_to("active")
    kept = served.label_info().class_map[0].class_name
    assert served.set(classes=[kept]) == (True, "")
    done, reason = served.set(weights=str(other))
    assert not done
    assert f"'{kept}' is not a class of the model (apple, pear)" in reason
    assert served.get("weights") == str(good)
    assert served.set(weights=str(other), classes=["pear"]) == (True, "")
    assert [label.class_name for label in served.label_info().class_map] == ["apple", "pear"]


def test_dumped_parameters_fed_back_reproduce_the_configuration(
    served: ServedNode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert served.set(classes=["0"], confidence_threshold=0.5, lazy=False, max_rate=3.0) == (True, "")
    served.bring_to("active")
    digest = served.values()["configuration"]
    values = {setting.name: served.get(setting.name) for setting in SETTINGS}
    dump = tmp_path / "dump.yaml"
    dump.write_text(yaml.dump({"/yolov5": {"ros__parameters": values | {"use_sim_time": False}}}))
    # In one domain a request would be answered by both nodes of this name.
    with worker_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        with ServedNode(prepare_model, arguments=["--ros-args", "--params-file", str(dump)]) as again:
            again.bring_to("inactive")
            assert again.values()["configuration"] == digest
