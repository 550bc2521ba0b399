"""Selection of how many frames run at the same time, measured: each in an inference stream of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.process.memory import cores, resident_mb
from yolov5_lifecycle.runtimes.speed import measure_streams_ms

_HARDLY_SLOWER = 1.05
"""At about the same time per frame streams are better: they take less processor time, and beside other busy
processes they do not wait for one another.
"""
_MIN_GAIN = 0.95
"""More streams, which need more memory, are used if they take less time per frame than this part."""
MEMORY_RATIO_LIMIT = 1.25
"""Of the process with streams to the process without; more only if `parallel_frames` asks for them."""


@dataclass(frozen=True)
class InferenceStreams:
    """Detectors for frames of different cameras at the same time, and why these; empty: one at a time."""

    detectors: tuple[Detector, ...] = ()
    reason: str = ""

    def close(self) -> None:
        """Free the networks. Idempotent."""
        for detector in self.detectors:
            detector.close()


def processors() -> int:
    """How many threads may compute at once: as many as torch uses, or as the control group allows."""
    quota = cores()
    count = torch.get_num_threads()
    return count if quota is None else max(1, min(count, math.ceil(quota)))


def choose_streams(
    detector: Detector,
    sizes_hw: Sequence[tuple[int, int]],
    *,
    most: int,
    is_asked: bool,
    measure: Callable[..., tuple[float, float]] = measure_streams_ms,
    resident: Callable[[], float | None] = resident_mb,
) -> InferenceStreams:
    """As many streams as are worth it, at most `most`; all of them, without a measurement, if it `is_asked`.

    `sizes_hw`: height and width of the images of every camera, for which `detector` is warm. Raises
    InferenceError when a frame fails, DeviceError for streams on a device that runs one frame at a time.
    """
    if len(sizes_hw) < 2:
        return InferenceStreams(reason="1: there is only one camera")
    if most < 2:
        is_wanted = is_asked and processors() > 1
        return InferenceStreams(reason="1: as set" if is_wanted else "1: there is one processor")
    if is_asked:
        return InferenceStreams(_warm_streams(detector, most, sizes_hw), f"{most}: as set")
    if detector.runtime.device != "cpu":
        return InferenceStreams(reason=f"1: {detector.runtime.device} runs one frame at a time")
    return _fastest(detector, most, sizes_hw, measure, resident)


def _fastest(
    detector: Detector,
    most: int,
    sizes_hw: Sequence[tuple[int, int]],
    measure: Callable[..., tuple[float, float]],
    resident: Callable[[], float | None],
) -> InferenceStreams:
    """The number of streams with the least time per frame, of those that do not take too much memory."""
    frames_hw = [*dict.fromkeys(map(detector.network_hw, sizes_hw))]
    best, best_ms, figures = InferenceStreams(), math.inf, list[str]()
    alone_mb = resident() or math.inf
    for count in sorted({most, *(size for size in (2, 4, 8) if size < most)}):
        before_mb = resident() or 0.0  # with the best ones so far
        streams = InferenceStreams(_warm_streams(detector, count, sizes_hw))
        alone_ms, together_ms = measure(
            detector.runtime, [stream.runtime for stream in streams.detectors], frames_hw=frames_hw
        )
        figures.append(f"{count} at once {together_ms:.1f} ms a frame, alone {alone_ms:.1f} ms")
        limit_ms = min(_HARDLY_SLOWER * alone_ms, _MIN_GAIN * best_ms)
        more_mb = (resident() or 0.0) - before_mb
        if alone_mb + more_mb > MEMORY_RATIO_LIMIT * alone_mb:
            figures.append(f"not used: {more_mb:.0f} MB more than {alone_mb:.0f} MB")
        elif together_ms <= limit_ms:
            best.close()
            best, best_ms = streams, together_ms
            continue
        streams.close()
    return InferenceStreams(best.detectors, f"{max(1, len(best.detectors))}: {', '.join(figures)}")


def _warm_streams(
    detector: Detector, count: int, sizes_hw: Sequence[tuple[int, int]]
) -> tuple[Detector, ...]:
    """`count` streams, warmed up at once in threads that end: torch keeps settings in each thread."""
    streams = detector.streams(count, max(1, processors() // count))
    try:
        with ThreadPoolExecutor(count) as threads:
            for _ in threads.map(lambda stream: stream.warm_up(sizes_hw), streams):
                pass
    except BaseException:
        InferenceStreams(streams).close()
        raise
    return streams
