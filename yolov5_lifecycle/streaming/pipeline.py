"""Interface of the code that the worker runs on frames, one at a time or in batches."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

Frame = TypeVar("Frame")
Result = TypeVar("Result")
AnyFrame = TypeVar("AnyFrame", contravariant=True)
AnyResult = TypeVar("AnyResult", covariant=True)

Send = Callable[[], object]
"""Sends one finished message."""


class Pipeline(Protocol[AnyFrame, Result]):
    """Processes a frame, in the worker's thread."""

    @property
    def network(self) -> object:
        """What one thread at a time may use. An abandoned frame keeps it until the frame's thread has ended:
        until then no other frame with the same network, compared by identity, begins.
        """

    def detect(self, frame: AnyFrame) -> Result:
        """The result for `frame`. Raises ImageError when the frame is unreadable."""

    def messages(self, result: Result) -> Iterator[Send]:
        """Compute what to publish of the result of `detect`, one message after the other.

        Each item sends one message and computes nothing. The frame may be abandoned between any two items;
        then the rest is never asked for.
        """


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
