"""Selection of the sizes of batches that are faster than single images, measured."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from yolov5_lifecycle.detection.detector import Batches, Detector
from yolov5_lifecycle.runtimes.speed import measure_batches_ms

MIN_GAIN_PERCENT = 5
"""Batches are used if they take less time per image by at least this much."""


def choose_batches(
    detector: Detector,
    sizes_hw: Sequence[tuple[int, int]],
    *,
    max_batch: int,
    measure: Callable[..., dict[int, float]] = measure_batches_ms,
) -> Batches:
    """The sizes of batches that are faster per image than single images; networks for other sizes are freed.

    `sizes_hw`: height and width of the images of every camera, for which `detector` is warm. Batches of two
    images are measured, and of as many as there are cameras with the same network input size, up to
    `max_batch`. Raises InferenceError when a single image fails.
    """
    if len(sizes_hw) < 2:
        return Batches((), "none: there is only one camera")
    cameras = Counter(map(detector.network_hw, sizes_hw))
    shared_hw = [network_hw for network_hw, count in cameras.items() if count > 1]
    if not shared_hw:
        return Batches((), "none: no two cameras have the same network input size")
    sizes = sorted({2, min(max_batch, max(cameras.values()))})
    figures_ms = measure(detector.runtime, sizes, frames_hw=shared_hw)
    limit_ms = (1 - MIN_GAIN_PERCENT / 100) * figures_ms[1]
    chosen = tuple(size for size in sizes if figures_ms.get(size, float("inf")) <= limit_ms)
    detector.runtime.keep_batches(chosen)
    return Batches(chosen, _reason(chosen, figures_ms))


def _reason(chosen: Sequence[int], figures_ms: Mapping[int, float]) -> str:
    """Such as "of 2: single 16.0 ms an image, of 2 12.1 ms, of 4 15.8 ms"."""
    result = f"of {' or '.join(map(str, chosen))}" if chosen else "none"
    single_ms, *batches_ms = (f"{ms:.1f} ms" for _, ms in sorted(figures_ms.items()))
    sizes = sorted(figures_ms)[1:]
    if not sizes:
        return f"{result}: single {single_ms} an image, batches failed or took too long to measure"
    figures = ", ".join(f"of {size} {ms}" for size, ms in zip(sizes, batches_ms, strict=True))
    return f"{result}: single {single_ms} an image, {figures}"
