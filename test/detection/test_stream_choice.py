"""How many frames run at the same time is measured, bounded by memory and by processors, and explained."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.random_model import CLASS_NAMES, random_model
from support.runtime_names import EVERY_RUNTIME
from support.scripted_runtime import ScriptedRuntime

from yolov5_lifecycle.detection import prepared_model, stream_choice
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.prepared_model import load_detector, most_streams
from yolov5_lifecycle.detection.stream_choice import InferenceStreams, choose_streams, processors
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.runtimes.torch_device import DeviceError
from yolov5_lifecycle.settings.settings import Settings

VGA = (480, 640)


@pytest.fixture(autouse=True)
def _machine(monkeypatch: pytest.MonkeyPatch) -> None:
    set_processors(monkeypatch, 8)


def set_processors(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    for module in (stream_choice, prepared_model):
        monkeypatch.setattr(module, "processors", lambda: count)


def nothing() -> NDArray[np.float32]:
    return np.empty((0, 5 + len(CLASS_NAMES)), np.float32)


def scripted() -> Detector:
    return Detector(ScriptedRuntime(nothing), class_names=CLASS_NAMES, image_size=640, stride=32)


def with_cameras(count: int, parallel_frames: int = 0) -> Settings:
    names = tuple(f"c{number}" for number in range(count)) if count > 1 else ()
    return Settings(cameras=names, parallel_frames=parallel_frames)


def wish(settings: Settings) -> dict[str, Any]:
    return {"most": most_streams(settings), "is_asked": settings.parallel_frames > 0}


def chosen(
    detector: Detector,
    settings: Settings,
    together_ms: dict[int, float],
    resident: Callable[[], float | None] = lambda: 400.0,
) -> InferenceStreams:
    """Choose where a frame takes 20 ms alone, and `together_ms` with that number of streams."""

    def measure(whole: object, streams: Sequence[object], *, frames_hw: object) -> tuple[float, float]:
        return 20.0, together_ms[len(streams)]

    sizes_hw = [VGA] * len(settings.camera_names)
    return choose_streams(detector, sizes_hw, **wish(settings), measure=measure, resident=resident)


@pytest.mark.parametrize(
    ("together_ms", "count"),
    [
        pytest.param({2: 15.0, 4: 12.0, 6: 13.0}, 4, id="best in the middle"),
        pytest.param({2: 21.1, 4: 21.5, 6: 30.0}, 0, id="slower"),
        pytest.param({2: 20.9, 4: 20.5, 6: 30.0}, 2, id="hardly slower"),
    ],
)
def test_the_fastest_number_of_streams_is_used_and_the_others_are_freed(
    together_ms: dict[int, float], count: int
) -> None:
    detector = scripted()
    streams = chosen(detector, with_cameras(6), together_ms)
    assert len(streams.detectors) == count
    assert streams.reason.startswith(f"{max(1, count)}: 2 at once {together_ms[2]:.1f} ms a frame")
    runtime: Any = detector.runtime
    assert [stream for stream in runtime.made_streams if not stream.is_closed] == [
        each.runtime for each in streams.detectors
    ]


def test_streams_that_take_too_much_memory_are_not_used_and_the_reason_says_so() -> None:
    resident = iter([400.0, 400.0, 501.0])
    streams = chosen(scripted(), with_cameras(2), {2: 10.0}, lambda: next(resident))
    assert (streams.detectors, streams.reason) == (
        (),
        "1: 2 at once 10.0 ms a frame, alone 20.0 ms, not used: 101 MB more than 400 MB",
    )


@pytest.mark.parametrize(
    ("processors", "cameras", "parallel_frames", "count", "reason"),
    [
        pytest.param(8, 1, 0, 0, "1: there is only one camera", id="one camera"),
        pytest.param(1, 6, 0, 0, "1: there is one processor", id="one processor"),
        pytest.param(8, 6, 1, 0, "1: as set", id="one at a time"),
        pytest.param(8, 6, 16, 6, "6: as set", id="no more than cameras"),
        pytest.param(8, 12, 16, 8, "8: as set", id="no more than processors"),
    ],
)
def test_nothing_is_measured_where_there_is_no_choice(
    processors: int,
    cameras: int,
    parallel_frames: int,
    count: int,
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    set_processors(monkeypatch, processors)
    streams = chosen(scripted(), with_cameras(cameras, parallel_frames), {})
    assert (len(streams.detectors), streams.reason) == (count, reason)


@pytest.mark.parametrize(("quota", "count"), [(None, 8), (2.5, 3), (0.5, 1), (99.0, 8)])
def test_a_control_group_limits_the_processors(
    quota: float | None, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_choice, "cores", lambda: quota)
    monkeypatch.setattr("torch.get_num_threads", lambda: 8)
    assert processors() == count


class OneAtATime(ScriptedRuntime):
    """On a device that runs one frame at a time."""

    device = "cuda:0"

    def streams(self, count: int, threads: int) -> list[ScriptedRuntime]:
        raise DeviceError("one at a time")


def test_a_gpu_runs_one_frame_at_a_time_and_refuses_more() -> None:
    detector = Detector(OneAtATime(nothing), class_names=CLASS_NAMES, image_size=640, stride=32)
    assert chosen(detector, with_cameras(6), {}).reason == "1: cuda:0 runs one frame at a time"
    with pytest.raises(DeviceError):
        chosen(detector, with_cameras(6, parallel_frames=2), {})


def test_streams_that_fail_are_freed() -> None:
    detector = scripted()
    runtime: Any = detector.runtime

    def fail() -> NDArray[np.float32]:
        raise InferenceError("out of memory")

    runtime.run = fail
    with pytest.raises(InferenceError, match="out of memory"):
        chosen(detector, with_cameras(2, parallel_frames=2), {})
    assert [stream.is_closed for stream in runtime.made_streams] == [True, True]


@pytest.mark.long
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_every_runtime_is_measured(runtime: str) -> None:
    detector = load_detector(
        random_model(0), runtime=runtime, device="cpu", precision="fp32", image_size=320, cameras=2
    )
    detector.warm_up([VGA])
    streams = choose_streams(detector, [VGA, VGA], **wish(with_cameras(2)))
    assert "2 at once" in streams.reason
    assert len(streams.detectors) in (0, 2)
    assert most_streams(with_cameras(2)) == 2
