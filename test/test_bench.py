"""The figures of `make bench`: measured in processes of their own, summed up without mistakes."""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import json
import os
from array import array
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from support.colcon_workspace import REPOSITORY
from support.random_model import TINY_SEGMENT, random_model

from benchmark import collected_errors, collecting, console, families, masks, precisions, recordings, report
from benchmark.bench import forward_goals, set_max_rate
from benchmark.camera_fleet import LAYOUTS, Arrival, Layout, Passage, active_fleet
from benchmark.cameras import layout_goals, layout_rows, ratios_of
from benchmark.collected_errors import PLACES, SIZE_HW, USUAL, Outcome, drive, errors
from benchmark.collecting import NOTHING_KEPT, OFF, ONE_A_SECOND
from benchmark.contender import Task, contender, measure
from benchmark.fairness import (
    equal_shares,
    others_rates,
    overtaking,
    share_deviation_percent,
    slow_beside_fast,
)
from benchmark.light_camera import unreadable_images
from benchmark.mask_accuracy import EXACT, ROUNDED, WEIGHTS, boxes_of_yolov5, compared
from benchmark.recordings import ONE, ONE_CORE, SINGLE, TWO
from benchmark.report import Goal, goal_table, in_turns, publish, row, table
from benchmark.rivals import RIVALS, call_of
from benchmark.work import image_file
from tools.shapes.evaluate import UNSEEN_SEED, stills
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.collecting.collected_files import kept_images
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.offline.recording import open_recording
from yolov5_lifecycle.ros.messages import image_of_message
from yolov5_lifecycle.runtimes.processor_abilities import abilities, has_bf16
from yolov5_lifecycle.runtimes.registry import installed_runtimes
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Truth

pytestmark = pytest.mark.long

SHAPES = REPOSITORY / "weights" / "shapes.safetensors"
IMAGE_HW = (96, 128)
EAGER = Task("rivals", "eager torch", str(SHAPES), IMAGE_HW)
DETECTOR = Task("work", "runtime torch", str(SHAPES), IMAGE_HW)
CAMERAS = ("left", "right")


def missed(goals: Sequence[Goal]) -> list[str]:
    return [goal.what for goal in goals if not goal.is_reached]


# What is measured in turns, and reported


def test_calls_are_measured_in_turns_after_those_that_warm_up() -> None:
    made: list[str] = []

    def call(name: str) -> int:
        made.append(name)
        return len(made)

    calls = {name: partial(call, name) for name in "ab"}
    assert in_turns(calls, 2, warm_ups=1) == {"a": [3, 5], "b": [4, 6]}
    assert made == list("ababab")
    in_turns(calls, 2, mirrored=True)
    assert made[6:] == list("abba")


def test_a_row_has_median_p95_and_the_spread_of_the_quartiles() -> None:
    figures = row("forward", "torch", 1, [*range(1, 100), 1000])
    assert (figures.median, figures.p95) == (50.5, 95)
    assert figures.spread == pytest.approx((75 - 26) / 50.5)


def test_ratios_are_to_the_best_of_the_same_load() -> None:
    rows = [row("forward", "a", 0, [10]), row("forward", "b", 0, [15]), row("forward", "c", 1, [30])]
    assert [line.split()[-2] for line in table(rows).splitlines()[2:]] == ["1.00", "1.50", "1.00"]


def test_a_goal_is_reached_up_to_its_bound() -> None:
    found = [Goal("", 0, value, at_most, 1.1).is_reached for at_most in (True, False) for value in (1.1, 1.2)]
    assert found == [True, False, True, True]
    assert not Goal("", 0, 1.0, False, 1.1).is_reached
    assert goal_table([Goal("ratio", 0, 2.0, True, 1.1)]).startswith("MISSED")


def test_the_report_has_what_was_measured_and_where(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(report, "FOLDER", tmp_path / "bench")
    publish(
        "tried",
        argparse.Namespace(busy=1),
        [row("forward", "a", 0, [10.0])],
        [Goal("ratio", 0, 2.0, True, 1.1)],
    )
    written = json.loads((tmp_path / "bench" / "tried.json").read_text())
    assert written["rows"][0]["median"] == 10.0
    assert written["goals"][0]["is_reached"] is False
    assert written["options"] == {"busy": "1"}
    assert "torch" in written["versions"]
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


def test_a_contender_that_fails_is_named() -> None:
    absent = dataclasses.replace(DETECTOR, name="runtime abacus")
    with pytest.raises(RuntimeError, match="'runtime abacus' failed"), contender(absent, os.environ):
        pass


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


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        pytest.param({}, [], id="all reached"),
        pytest.param({"OpenVINO": 9.0}, ["forward / best bare rival"], id="a faster rival"),
        pytest.param({"eager torch": 20.0}, ["eager torch / forward"], id="fast usual way"),
        pytest.param({"detector": 12.5}, ["detector / forward"], id="a slow detector"),
    ],
)
def test_the_goals_of_forwards_compare_with_the_best_rival_and_the_usual_way(
    changed: dict[str, float], expected: list[str]
) -> None:
    medians_ms = {"runtime auto": 10.0, "detector": 11.0, "eager torch": 30.0}
    rivals_ms = {"ONNX Runtime": 12.0, "ONNX Runtime, no spinning": 11.0, "OpenVINO": 9.5}
    assert missed(forward_goals(medians_ms | rivals_ms | changed, busy=0)) == expected


def test_a_family_is_slow_when_no_runtime_is_as_fast_as_eager_torch() -> None:
    found = dict(families.families())
    assert set(families.QUICK) <= found.keys()
    assert len(set(found.values())) == len(found) > 25
    rows = [
        row("v3.0/yolov5s", name, 0, [ms]) for name, ms in ((families.EAGER, 10.0), ("runtime torch", 12))
    ]
    assert not families.goal(rows).is_reached
    assert families.goal([*rows, row("v3.0/yolov5s", "runtime openvino", 0, [5.0])]).value == 0.5


@pytest.mark.skipif("openvino" not in installed_runtimes(), reason="no openvino: make install")
def test_every_precision_of_the_processor_is_measured() -> None:
    taken_ms = masks.measured_ms(precisions.calls(random_model(), (64, 96)), turns=2)
    expected = {f"fp32 in {name}" for name in installed_runtimes() if name != "torch"} | {precisions.INT8}
    assert taken_ms.keys() == expected | ({"bf16 in openvino"} if has_bf16(abilities()) else set())
    assert all(len(times_ms) == 2 for times_ms in taken_ms.values())


def test_int8_is_compared_with_the_fastest_fp32() -> None:
    int8 = {precisions.INT8: [10.0]}
    reached = precisions.goal("n", {"fp32 in openvino": [18.0], "fp32 in onnxruntime": [15.0], **int8})
    assert (reached.value, reached.is_reached) == (1.5, True)
    assert not precisions.goal("n", {"fp32 in openvino": [14.0], **int8}).is_reached


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
        total_hz, _, shares = equal_shares(fleet, names, image, rate_hz=10.0, duration_s=2.0)
        _, delays = slow_beside_fast(fleet, CAMERAS, image, rates_hz=(5.0, 50.0), passages=[2.0])
        rows, changes = others_rates(fleet, names, image, rate_hz=5.0, passages=[2.0])
    assert total_hz > 0
    assert (len(shares), len(delays), len(changes)) == (1, 2, len(rows) - 1)
    assert min(row.median for row in rows) > 0


def arrivals(*seen: tuple[str, int, int]) -> list[Arrival]:
    """Of camera, stamp and receipt in milliseconds."""
    return [Arrival(camera, stamp * 1_000_000, received * 1_000_000) for camera, stamp, received in seen]


def passage(latencies_ms: Sequence[int], cpu_s: float, memory_mb: float = 100.0) -> Passage:
    """Of one camera in two seconds."""
    seen = arrivals(*(("left", 0, latency_ms) for latency_ms in latencies_ms))
    return Passage(seen, 2.0, cpu_s, memory_mb, 2 * memory_mb)


def test_a_younger_image_that_is_served_before_a_slow_one_has_overtaken_it() -> None:
    before = [("fast", 5, 20), ("slow", 10, 40), ("fast", 15, 60)]
    assert overtaking(arrivals(*before, ("fast", 50, 70), ("fast", 55, 80), ("slow", 52, 90)), "slow") == [
        0,
        1,
    ]


def test_shares_deviate_by_the_smallest_from_the_largest() -> None:
    counts = ([50, 50, 50], [45, 50, 48], [0, 50], [0, 0])
    assert [*map(share_deviation_percent, counts)] == pytest.approx([0.0, 10.0, 100.0, 100.0])


def test_the_rate_is_that_of_the_stamps() -> None:
    seen = arrivals(("left", 0, 50), ("left", 100, 900), ("left", 200, 1500))
    assert Passage(seen, 2.0, 0.3, 0.0, 0.0).stamped_hz == pytest.approx(10.0)


def test_layouts_are_compared_in_each_round() -> None:
    ratios = ratios_of([passage([10, 20, 30], 0.3)], [passage([40, 40], 0.4, 400.0)])
    expected = {"detections": 1.5, "median": 0.5, "p95": 0.75, "CPU": 0.5, "PSS": 0.25, "RSS": 0.25}
    assert ratios == {name: [ratio] for name, ratio in expected.items()}
    good = {"detections": 1.2, "PSS": 0.35, "p95": 0.8}
    for changed, count in (({}, 0), ({"detections": 0.9}, 1), ({"PSS": 0.5, "p95": 1.1}, 2)):
        assert len(missed(layout_goals(good | changed))) == count
    rows = {row.name: row.median for row in layout_rows("one node", 4, [passage([10, 20], 0.3)] * 2)}
    assert rows["one node, latency"] == 15.0
    assert rows["one node, detections"] == 1.0
    assert rows["one node, CPU"] == pytest.approx(15.0)


def test_the_garbage_of_a_misbehaving_camera_is_unreadable() -> None:
    height, width = IMAGE_HW
    whole = Image(height=height, width=width, step=3 * width, encoding="bgr8")
    whole.data = array("B", bytes(3 * height * width))
    image_of_message(whole)
    for message in unreadable_images(whole):
        with pytest.raises(ImageError):
            image_of_message(message)


# Collected images


def test_each_round_is_compared_with_the_same_round_without_collecting() -> None:
    rows, goals = collecting.figures(
        {
            OFF: [passage([10], 0.8), passage([20], 1.6), passage([10], 0.8)],
            NOTHING_KEPT: [passage([10], 0.82), passage([20], 1.62), passage([30], 1.8)],
            ONE_A_SECOND: [passage([11], 1.1), passage([22], 1.9), passage([11], 1.1)],
        }
    )
    assert [goal.value for goal in goals] == pytest.approx([1.0, 1.0, 15.0, 1.1])
    assert [goal.is_reached for goal in goals] == [True, True, False, False]
    assert [each.median for each in rows if each.what == "CPU"] == pytest.approx([40, 81, 55])


@pytest.mark.usefixtures("_environment")
@pytest.mark.parametrize(("way", "kept"), [(OFF, 0), (NOTHING_KEPT, 1), (ONE_A_SECOND, 2)])
def test_a_detector_collects_as_the_figures_say(way: str, kept: int, tmp_path: Path) -> None:
    options = argparse.Namespace(rate=10.0, seconds=2.5)
    measured = collecting.passage(way, SHAPES, image_file(IMAGE_HW, tmp_path), tmp_path, options)
    assert measured.cpu_s > 0
    found = len([*kept_images(tmp_path / "collected")]) if way != OFF else 0
    assert found == kept if way != ONE_A_SECOND else found >= kept


BOXES = np.array([[0, 0, 10, 10], [20, 20, 40, 40]], np.float32)
TRUTH = Truth(BOXES, np.array([0, 1], np.int64))


@pytest.mark.parametrize(
    ("boxes", "class_ids", "expected"),
    [
        pytest.param(BOXES[::-1], (1, 0), 0, id="in another order"),
        pytest.param(BOXES[:1], (0,), 1, id="one missed"),
        pytest.param(BOXES[:0], (), 2, id="none found"),
        pytest.param(BOXES, (0, 0), 2, id="another class"),
        pytest.param(BOXES + 100, (0, 1), 4, id="elsewhere"),
        pytest.param(BOXES[[0, 1, 1]], (0, 1, 1), 1, id="one twice"),
    ],
)
def test_errors_are_missed_false_and_confused_objects(
    boxes: NDArray[np.float32], class_ids: tuple[int, ...], expected: int
) -> None:
    scores = np.full(len(boxes), 0.9, np.float32)
    assert errors(Detections(boxes.copy(), scores, np.array(class_ids, np.int64)), TRUTH) == expected


def test_a_fifth_of_the_places_of_a_drive_are_difficult_and_its_truth_is_in_the_image() -> None:
    frames = list(drive(3))
    assert [frame.number for frame in frames] == list(range(len(frames)))
    kinds = {frame.place: frame.weakness for frame in frames}
    assert len(kinds) == PLACES
    assert sum(kind != USUAL for kind in kinds.values()) == PLACES // 5
    assert {*kinds.values()} == {USUAL, "blur", "night", "small", "new look"}
    for frame in frames:
        assert frame.pixels.shape == (*SIZE_HW, 3)
        assert (frame.truth.boxes_xyxy >= 0).all()
        assert (frame.truth.boxes_xyxy[:, 2:] <= SIZE_HW[::-1]).all()
    assert {len(frame.truth.class_ids) > 0 for frame in frames} == {True, False}


def test_the_figures_compare_kept_images_with_all() -> None:
    moved = Truth(BOXES + np.array([5, 0, 5, 0], np.float32), TRUTH.class_ids)
    outcome = Outcome(
        errors=[0, 0, 4, 4],
        weaknesses=[USUAL, USUAL, "blur", "night"],
        places=[0, 0, 1, 1],
        truths=[TRUTH, moved, TRUTH, TRUTH],
        kept=[2, 3],
    )
    assert outcome.density_ratio == 2.0
    assert outcome.duplicates == 0.5  # the last shows what the one before shows
    assert dataclasses.replace(outcome, kept=[0, 1]).duplicates == 0
    _, goals = collected_errors.figures([outcome])
    assert [goal.value for goal in goals] == [2.0, 50.0, 2]
    assert len(missed(goals)) == len(goals)


# Console, masks, recordings


def test_the_age_is_compared_with_the_latency_and_the_cost_with_that_of_one_viewer() -> None:
    def seen(age_ms: float, cpu_s: float) -> list[console.Viewing]:
        return [console.Viewing([age_ms] * 100, [20.0, 30.0], cpu_s, 10.0)]

    age, cost = console.goals({1: seen(125.0, 1.0), 4: seen(1000.0, 1.3)})
    assert (age.value, age.is_reached) == (100.0, True)
    assert cost.value == pytest.approx(1.3)
    assert len(missed(console.goals({1: seen(126.0, 1.0), 4: seen(126.0, 1.4)}))) == 2


@pytest.mark.usefixtures("_environment")
def test_two_viewers_see_images() -> None:
    with console.robot(15.0) as process:
        found = asyncio.run(console.viewing(process, 2, 2.0))
    assert found.ages_ms
    assert min(found.ages_ms) > 0
    assert found.cpu_s >= 0


def test_every_call_of_masks_is_measured_in_every_turn(tmp_path: Path) -> None:
    path = tmp_path / "segment.safetensors"
    write_safetensors(random_model(1, TINY_SEGMENT), path)
    taken_ms = masks.measured_ms(masks.calls(path, IMAGE_HW), turns=2)
    assert len(taken_ms) == 4 + len(masks.COUNTS)
    assert all(len(times_ms) == 2 and min(times_ms) > 0 for times_ms in taken_ms.values())
    write_safetensors(random_model(1), tmp_path / "detect.safetensors")
    with pytest.raises(ValueError, match="expected a model that segments"):
        masks.calls(tmp_path / "detect.safetensors", IMAGE_HW)


def test_the_goal_of_masks_is_a_share_of_the_whole_forward_pass() -> None:
    forward = {masks.FORWARD: [10.0], masks.PROTOTYPES: [6.0]}
    reached = masks.goal({**forward, masks.of_objects(10): [4.0]})
    assert (reached.value, reached.is_reached) == (0.25, True)
    assert not masks.goal({**forward, masks.of_objects(10): [4.1]}).is_reached


def test_masks_are_those_of_the_reference_with_the_same_boxes_and_others_with_rounded_ones() -> None:
    detector = load_detector(load_weights(WEIGHTS).model, device="cpu", image_size=320)
    shares = compared(detector, stills(UNSEEN_SEED, 8, (250, 350)))
    assert len(shares[EXACT]) > 10
    assert max(shares[EXACT]) < 0.0005 < max(shares[ROUNDED])


@pytest.mark.parametrize(
    ("size_hw", "largest"),
    [
        pytest.param((480, 640), 0.0, id="no padding"),
        pytest.param((500, 700), 0.75 * 700 / 640, id="odd padding"),
        pytest.param((1080, 1920), 0.0, id="even padding"),
    ],
)
def test_yolov5_maps_boxes_back_to_almost_the_same_place(size_hw: tuple[int, int], largest: float) -> None:
    letterbox = Letterbox.fit(size_hw, image_size=640, stride=32)
    boxes_xyxy = masks.random_boxes(np.random.default_rng(0), 50, size_hw)
    assert ((boxes_xyxy >= 0) & (boxes_xyxy <= (*size_hw[::-1], *size_hw[::-1]))).all()
    moved = np.abs(boxes_of_yolov5(boxes_xyxy, letterbox) - boxes_xyxy).max()
    assert moved <= largest + 1e-3
    assert (moved > 0.1) == (largest > 0)


def test_the_recording_has_the_images_that_are_asked_for(tmp_path: Path) -> None:
    recordings.record_scene(tmp_path / "drive", 23)
    with open_recording(tmp_path / "drive") as recording:
        images = list(recording.messages(recording.image_topic()))
    assert [image.load().size_hw for image in images] == [(480, 640)] * 23


def test_the_goals_of_recordings_are_medians_of_the_ratios_of_each_round() -> None:
    taken_s = {SINGLE: [10.0, 20.0, 10.0], ONE: [10.4, 20.8, 99.0], ONE_CORE: [16.0] * 3, TWO: [10.0] * 3}
    goals = recordings.goals(taken_s)
    assert [goal.value for goal in goals] == pytest.approx([1.04, 1.6, 2.08])
    assert missed(goals) == []
