"""Interface of the code that the worker runs on frames, one at a time or in batches."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, Protocol, TypeVar

Frame = TypeVar("Frame")
Result = TypeVar("Result")
AnyFrame = TypeVar("AnyFrame", contravariant=True)
AnyResult = TypeVar("AnyResult", covariant=True)


class Pipeline(Protocol[AnyFrame, Result]):
    """Processes a frame, in the worker's thread."""

    def detect(self, frame: AnyFrame) -> Result:
        """The result for `frame`. Raises ImageError when the frame is unreadable."""

    def publish(self, result: Result) -> None:
        """Publish what `detect` returned; not called for a frame that was abandoned."""


class Batch(Protocol[AnyFrame, AnyResult]):
    """Detects in frames of several cameras at once, in the worker's thread.

    Each frame comes with the pipeline that its feed was started with, of any class.
    """

    @property
    def max_size(self) -> int:
        """Max number of frames at once; below 2 all frames run alone."""

    def key(self, pipeline: Any, frame: AnyFrame) -> Hashable | None:
        """Frames with equal keys may run together, with None alone.

        It must be cheap: no feed can offer a frame meanwhile. An exception counts as None, as `detect` of
        the pipeline will raise its own.
        """

    def detect(self, jobs: Sequence[tuple[Any, AnyFrame]]) -> Sequence[AnyResult | Exception]:
        """One result for each of `jobs`, in their order, or what its own `detect` would have raised.

        If it raises, all its frames fail.
        """
