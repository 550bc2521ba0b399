"""The figures of `make bench`: measured in processes of their own, summed up without mistakes."""

from __future__ import annotations

import argparse
import dataclasses
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY
from support.random_model import random_model

from benchmark import collecting, masks, precisions, report
from benchmark.bench import set_max_rate
from benchmark.camera_fleet import LAYOUTS, Layout, active_fleet
from benchmark.cameras import equal_shares, slow_beside_fast
from benchmark.collecting import NOTHING_KEPT, OFF, ONE_A_SECOND
from benchmark.contender import Task, measure
from benchmark.report import Goal, Program, row
from benchmark.rivals import RIVALS, call_of
from benchmark.work import image_file
from yolov5_lifecycle.collecting.collected_files import kept_images
from yolov5_lifecycle.runtimes.processor import abilities, has_bf16
from yolov5_lifecycle.runtimes.registry import installed_runtimes
from yolov5_lifecycle.sources.scene import CLASS_NAMES

pytestmark = pytest.mark.long

SHAPES = REPOSITORY / "weights" / "shapes.safetensors"
IMAGE_HW = (96, 128)
EAGER = Task("rivals", "eager torch", str(SHAPES), IMAGE_HW)
DETECTOR = Task("work", "runtime torch", str(SHAPES), IMAGE_HW)
CAMERAS = ("left", "right")


# What is measured in turns, and reported


def test_a_program_prints_and_writes_its_report_and_fails_where_its_goals_are_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(report, "FOLDER", tmp_path / "bench")
    assert masks.PROGRAM.main(["--quick", "--size", "128x96"]) == 0
    written = json.loads((tmp_path / "bench" / "masks.json").read_text())
    assert len(written["rows"]) == 4 + len(masks.COUNTS)
    assert all(each["median"] > 0 for each in written["rows"])
    assert written["options"]["size"] == "(96, 128)"
    assert "torch" in written["versions"]
    missed = [row("forward", "a", 0, [20.0])], [Goal("ratio", 0, 2.0, True, 1.1)]
    assert Program("tried", "", lambda *_: missed, is_judged=True).main([]) == 1
    assert "MISSED  ratio" in capsys.readouterr().out


# Forward passes


def test_contenders_measure_in_turns_beside_every_load(tmp_path: Path) -> None:
    taken_ms, peaks_mb = measure([EAGER, DETECTOR], loads=(0, 1), turns=2, cache=tmp_path)
    assert {key: len(times_ms) for key, times_ms in taken_ms.items()} == {
        (task, busy): 6 for task in (EAGER, DETECTOR) for busy in (0, 1)
    }
    assert min(time_ms for times_ms in taken_ms.values() for time_ms in times_ms) > 0
    assert peaks_mb.keys() == {EAGER, DETECTOR}
    assert min(peaks_mb.values()) > 50


def test_a_rival_that_does_not_run_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unknown = dataclasses.replace(EAGER, name="abacus")
    taken_ms, _ = measure([unknown, EAGER], loads=(0,), turns=1, cache=tmp_path)
    assert taken_ms.keys() == {(EAGER, 0)}
    assert "left out: 'abacus' failed" in capsys.readouterr().err


@pytest.mark.parametrize("name", RIVALS)
def test_a_rival_predicts_what_the_network_does(name: str) -> None:
    if name == "OpenCV DNN" and cv2.__version__ < "5":
        pytest.skip("OpenCV 4.6 cannot run the network")
    found, expected = (rows_of(call_of(task)()) for task in (dataclasses.replace(EAGER, name=name), EAGER))
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.01)


def rows_of(answer: Any) -> NDArray[np.float32]:
    """The rows in what a rival gives: them, or a collection that has them first."""
    rows = answer if isinstance(answer, (np.ndarray, torch.Tensor)) else answer[0]
    return np.asarray(rows).reshape(-1, 5 + len(CLASS_NAMES))


@pytest.mark.skipif("openvino" not in installed_runtimes(), reason="no openvino: make install")
def test_every_precision_of_the_processor_is_measured() -> None:
    taken_ms = report.measured_ms(precisions.calls(random_model(), (64, 96)), turns=2)
    expected = {f"fp32 in {name}" for name in installed_runtimes() if name != "torch"} | {precisions.INT8}
    assert taken_ms.keys() == expected | ({"bf16 in openvino"} if has_bf16(abilities()) else set())
    assert all(len(times_ms) == 2 for times_ms in taken_ms.values())


# Nodes and cameras


@pytest.mark.usefixtures("_environment")
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_camera_of_a_layout_is_watched(layout: Layout, tmp_path: Path) -> None:
    image = image_file(IMAGE_HW, tmp_path)
    with (
        active_fleet(layout, CAMERAS, weights=SHAPES, cache=tmp_path, image_size=128) as fleet,
        ExitStack() as stack,
    ):
        for name in CAMERAS:
            stack.enter_context(fleet.camera(name, image, rate_hz=10.0))
        fleet.wait_for(CAMERAS)
        set_max_rate(fleet, 0.0)
        passage = fleet.watch(CAMERAS, 2.0)
        assert min(fleet.change("deactivate"), fleet.change("activate")) > 0
        assert fleet.peak_resident_mb > 50
        assert fleet.idle_cpu_share(CAMERAS[0], image, rate_hz=10.0, duration_s=0.5) >= 0
    assert passage.counts.keys() == {*CAMERAS}
    assert min(passage.latencies_ms) > 0
    assert passage.cpu_s > 0
    assert 50 < passage.proportional_mb <= passage.resident_mb


@pytest.mark.usefixtures("_environment")
def test_cameras_that_share_a_node_are_judged(tmp_path: Path) -> None:
    image, names = image_file(IMAGE_HW, tmp_path), CAMERAS
    with active_fleet("one node", names, weights=SHAPES, cache=tmp_path, image_size=128) as fleet:
        rows, shares = equal_shares(fleet, names, image, rate_hz=10.0, duration_s=2.0)
        _, delays = slow_beside_fast(fleet, CAMERAS, image, rates_hz=(5.0, 50.0), passages=[2.0])
    assert rows[0].median > 0
    assert (len(shares), len(delays)) == (1, 2)


# Collected images


@pytest.mark.usefixtures("_environment")
@pytest.mark.parametrize(("way", "kept"), [(OFF, 0), (NOTHING_KEPT, 1), (ONE_A_SECOND, 2)])
def test_a_detector_collects_as_the_figures_say(way: str, kept: int, tmp_path: Path) -> None:
    options = argparse.Namespace(rate=10.0, seconds=2.5)
    measured = collecting.passage(way, SHAPES, image_file(IMAGE_HW, tmp_path), tmp_path, options)
    assert measured.cpu_s > 0
    found = len([*kept_images(tmp_path / "collected")]) if way != OFF else 0
    assert found == kept if way != ONE_A_SECOND else found >= kept


# Console, masks, recordings
