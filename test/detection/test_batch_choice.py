"""Batches are used where they were measured to be faster, and the reason is reported."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from support.random_model import CLASS_NAMES, random_model
from support.runtime_names import EVERY_RUNTIME
from support.scripted_runtime import ScriptedRuntime

from yolov5_lifecycle.detection.batch_choice import choose_batches
from yolov5_lifecycle.detection.detector import Batches, Detector
from yolov5_lifecycle.detection.loaded_detector import load_detector
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError
from yolov5_lifecycle.runtimes.speed import measure_batches_ms

VGA, HD = (480, 640), (720, 1280)


def nothing() -> NDArray[np.float32]:
    return np.empty((0, 5 + len(CLASS_NAMES)), np.float32)


def scripted() -> ScriptedRuntime:
    return ScriptedRuntime(nothing)


def detector_of(runtime: ScriptedRuntime) -> Detector:
    return Detector(runtime, class_names=CLASS_NAMES, image_size=640, stride=32)


class Measured:
    """Stands in for `measure_batches_ms`: returns `figures_ms` and notes what was asked for."""

    def __init__(self, figures_ms: dict[int, float]) -> None:
        self.figures_ms = figures_ms
        self.asked: list[tuple[list[int], list[tuple[int, int]]]] = []

    def __call__(
        self, _: object, sizes: Sequence[int], *, frames_hw: Sequence[tuple[int, int]]
    ) -> dict[int, float]:
        self.asked.append((list(sizes), list(frames_hw)))
        return self.figures_ms


@pytest.mark.parametrize(
    ("figures_ms", "sizes", "reason"),
    [
        pytest.param(
            {1: 16.0, 2: 12.1, 4: 11.0},
            (2, 4),
            "of 2 or 4: single 16.0 ms an image, of 2 12.1 ms, of 4 11.0 ms",
            id="both",
        ),
        pytest.param(
            {1: 16.0, 2: 15.2, 4: 15.3},
            (2,),
            "of 2: single 16.0 ms an image, of 2 15.2 ms, of 4 15.3 ms",
            id="5 % is enough",
        ),
        pytest.param(
            {1: 16.0, 2: 15.9, 4: 18.2},
            (),
            "none: single 16.0 ms an image, of 2 15.9 ms, of 4 18.2 ms",
            id="none",
        ),
        pytest.param(
            {1: 16.0, 4: 11.0}, (4,), "of 4: single 16.0 ms an image, of 4 11.0 ms", id="one left out"
        ),
        pytest.param(
            {1: 900.0},
            (),
            "none: single 900.0 ms an image, batches failed or took too long to measure",
            id="all left out",
        ),
    ],
)
def test_sizes_that_are_faster_are_chosen_and_only_these_kept(
    figures_ms: dict[int, float], sizes: tuple[int, ...], reason: str
) -> None:
    runtime = scripted()
    chosen = choose_batches(detector_of(runtime), [VGA] * 4, max_batch=8, measure=Measured(figures_ms))
    assert chosen == Batches(sizes, reason)
    assert runtime.kept_batches == sizes


@pytest.mark.parametrize(
    ("cameras", "max_batch", "asked"),
    [
        pytest.param([VGA, VGA], 8, ([2], [VGA]), id="two cameras"),
        pytest.param([VGA] * 5, 3, ([2, 3], [VGA]), id="more cameras than the maximum"),
        pytest.param([VGA] * 5, 8, ([2, 5], [VGA]), id="fewer cameras than the maximum"),
        pytest.param([VGA, (960, 1280)], 2, ([2], [VGA]), id="images of one network input size"),
        pytest.param(
            [VGA, HD, VGA, HD, HD, (640, 480)], 8, ([2, 3], [VGA, (384, 640)]), id="two shared sizes"
        ),
    ],
)
def test_two_and_as_many_as_cameras_share_a_network_input_size_are_measured(
    cameras: list[tuple[int, int]], max_batch: int, asked: tuple[list[int], list[tuple[int, int]]]
) -> None:
    measured = Measured({1: 16.0})
    choose_batches(detector_of(scripted()), cameras, max_batch=max_batch, measure=measured)
    assert measured.asked == [asked]


@pytest.mark.parametrize(
    ("cameras", "reason"),
    [
        pytest.param([], "there is only one camera", id="none"),
        pytest.param([VGA], "there is only one camera", id="one"),
        pytest.param([VGA, HD], "no two cameras have the same network input size", id="different sizes"),
    ],
)
def test_cameras_that_share_no_size_need_no_measurement(cameras: list[tuple[int, int]], reason: str) -> None:
    measured = Measured({})
    chosen = choose_batches(detector_of(scripted()), cameras, max_batch=8, measure=measured)
    assert chosen == Batches((), f"none: {reason}")
    assert measured.asked == []


@pytest.mark.long
@pytest.mark.parametrize("runtime_name", EVERY_RUNTIME)
def test_every_runtime_is_measured(runtime_name: str) -> None:
    runtime = load_detector(random_model(), runtime=runtime_name, image_size=64, cameras=4).runtime
    figures_ms = measure_batches_ms(runtime, [2, 3], frames_hw=[(64, 64), (32, 64)], max_s=math.inf)
    assert list(figures_ms) == [1, 2, 3]
    assert all(ms > 0 for ms in figures_ms.values())


def test_sizes_are_measured_alternately() -> None:
    runtime = scripted()
    measure_batches_ms(runtime, [2, 4], frames_hw=[VGA], max_s=math.inf)
    assert runtime.batches[:6] == [1, 1, 2, 2, 4, 4]
    rounds = runtime.batches[6:]
    assert rounds == [1, 2, 4] * (len(rounds) // 3)
    assert rounds


def test_batches_that_would_take_too_long_are_not_run() -> None:
    runtime = scripted()
    assert list(measure_batches_ms(runtime, [2, 4], frames_hw=[VGA], max_s=0.0)) == [1]
    assert set(runtime.batches) == {1}


def test_a_size_of_batch_that_fails_is_left_out_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    runtime = scripted()

    def fail_from_four() -> None:
        if runtime.batches[-1] >= 4:
            raise InferenceError("out of memory")

    runtime.on_batch = fail_from_four
    assert list(measure_batches_ms(runtime, [2, 4], frames_hw=[VGA], max_s=math.inf)) == [1, 2]
    assert "A batch size was not measured, because it failed: out of memory" in caplog.text


@pytest.mark.parametrize(
    ("fails_at", "error"),
    [
        pytest.param(1, InferenceError("out of memory"), id="a single frame"),
        pytest.param(2, DeviceLostError("the GPU is gone"), id="device lost"),
    ],
)
def test_a_failure_of_more_than_a_batch_is_raised(fails_at: int, error: InferenceError) -> None:
    runtime = scripted()

    def fail() -> None:
        if runtime.batches[-1] == fails_at:
            raise error

    runtime.on_batch = fail
    with pytest.raises(type(error), match=str(error)):
        measure_batches_ms(runtime, [2, 4], frames_hw=[VGA], max_s=math.inf)
