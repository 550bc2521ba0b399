"""A model is replaced while the node is active, or refused with the reason while the old one goes on."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.preparations import Preparations, prediction
from support.random_model import random_model
from support.served_node import ServedNode, class_ids_of, image

from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW
from yolov5_lifecycle.detection.prepared_model import prepare_model


def test_a_reload_swaps_the_model_and_frees_the_old_one(active: ServedNode, prepare: Preparations) -> None:
    active.detect()
    changed = {"weights": "/other.pt", "confidence_threshold": 0.5, "image_reliability": "reliable"}
    assert active.set(image_size=320, **changed) == (True, "")
    old, new = prepare.runtimes
    assert old.is_closed
    assert not new.is_closed
    active.wait_for_log("the model was replaced: weights /scripted.pt")
    new.run = lambda: prediction("dog", 0.8)
    assert class_ids_of(active.detect()) == ["dog"]
    assert active.transition("deactivate")
    assert active.transition("activate")
    image_hw = image().height, image().width
    assert prepare.sizes_hw == [[USUAL_SOURCE_HW], [image_hw], [image_hw]], "warmed up for the last image"


def test_a_refused_reload_leaves_model_and_value_alone(active: ServedNode, prepare: Preparations) -> None:
    prepare.refusal = "/broken.pt: this is no checkpoint"
    assert "/broken.pt: this is no checkpoint" in active.refusal(weights="/broken.pt")
    active.wait_for_log("the running model stays, its replacement was refused: /broken.pt")
    prepare.refusal_type, prepare.refusal = KeyError, "surprise"
    assert active.set(image_size=320) == (False, "KeyError: 'surprise'")
    active.wait_for_log("unexpected KeyError in yolov5/set_parameters_atomically:\n  Traceback")
    assert (active.get("weights"), active.get("image_size")) == ("", 640)
    assert class_ids_of(active.detect()) == ["cat"]
    assert not prepare.running.is_closed


def test_a_reload_that_another_change_contradicts_is_refused_and_freed(
    active: ServedNode, prepare: Preparations
) -> None:
    prepare.gate.clear()
    prepare.class_names = ("star", "circle")
    reload = active.begin_set(weights="/other.pt")
    active.wait_for(lambda: len(prepare.sizes_hw) == 2, "the reload to begin")
    assert active.set(classes=["cat"]) == (True, "")
    prepare.gate.set()
    active.wait_for(reload.done, "the answer")
    assert not reload.result().result.successful
    assert "`classes` still names classes of the running model" in reload.result().result.reason
    assert [runtime.is_closed for runtime in prepare.runtimes] == [False, True]
    assert class_ids_of(active.detect()) == ["cat"]


# Weights files


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "good.safetensors"
    write_safetensors(random_model(), path)
    return path


@pytest.fixture
def real(ros_domain: int, good: Path) -> Iterator[ServedNode]:
    parameters = [f"weights:={good}", "image_size:=64", "runtime:=torch"]
    with ServedNode(prepare_model, parameters=parameters) as served:
        yield served


BAD_FILES: list[tuple[Callable[[Path], object], str, str]] = [
    (lambda bad: None, "missing.safetensors", "no such file"),
    (lambda bad: bad.mkdir(), "folder.safetensors", "regular file"),
    (lambda bad: os.mkfifo(bad), "pipe.pt", "regular file"),
    (lambda bad: bad.write_bytes(b"<!DOCTYPE html>"), "page.pt", "HTML page"),
]


def test_a_bad_file_is_refused_by_activate_and_by_a_swap(real: ServedNode, good: Path) -> None:
    real.bring_to("inactive")
    for spoil, name, message in BAD_FILES:
        bad = good.with_name(name)
        spoil(bad)
        assert real.set(weights=str(bad)) == (True, "")
        assert not real.transition("activate")
        told = real.status().message
        assert str(bad) in told
        assert message in told
    assert real.set(weights=str(good)) == (True, "")
    assert real.transition("activate")
    for _, name, message in BAD_FILES:
        reason = real.refusal(weights=str(good.with_name(name)))
        assert name in reason
        assert message in reason
    digest = real.values()["sha256"]
    reason = real.refusal(weights_sha256="0" * 64)
    assert digest in reason
    assert "0" * 64 in reason
    assert real.set(weights_sha256=digest) == (True, "")
    assert real.get("weights") == str(good)
    assert real.detect().header.stamp.sec > 0


def test_a_file_that_has_changed_is_loaded_when_its_path_is_set_again(real: ServedNode, good: Path) -> None:
    real.bring_to("active")
    before = real.values()["sha256"]
    write_safetensors(random_model(1), good)
    assert real.set(confidence_threshold=0.3) == (True, "")
    assert real.values()["sha256"] == before, "nobody has asked for it"
    assert real.set(weights=str(good)) == (True, "")
    after = real.values()["sha256"]
    assert after != before
    real.wait_for_log("the model was replaced")
    assert real.set(weights=str(good)) == (True, "")
    good.write_bytes(b"")
    assert str(good) in real.refusal(weights=str(good))
    good.unlink()
    assert "no such file" in real.refusal(weights=str(good))
    assert real.values()["sha256"] == after
    assert sum("the model was replaced" in said for said in real.log) == 1


def test_a_reload_for_another_setting_tells_that_it_has_read_another_file(
    real: ServedNode, good: Path
) -> None:
    real.bring_to("active")
    write_safetensors(random_model(1), good)
    assert real.set(image_size=128) == (True, "")
    real.wait_for_log("the weights are no longer those that were loaded before")
