"""Interface of the code that the worker runs on frames, one at a time or in batches."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

Frame = TypeVar("Frame")
AnyFrame = TypeVar("AnyFrame", contravariant=True)
Result = TypeVar("Result")

Send = Callable[[], object]
"""Sends one finished message."""


class Batch(Protocol):
    """Detects in frames of several cameras at once, in an inference thread.

    Each frame, of any class like the results, comes with the pipeline that its feed was started with.
    """

    @property
    def max_size(self) -> int:
        """Max number of frames at once; below 2 all frames run alone."""

    def key(self, pipeline: Any, frame: Any) -> Hashable:
        """Frames with equal keys may run together.

        It must be cheap: no feed can offer a frame meanwhile. After an exception the frame runs alone, as
        `detect` of the pipeline will raise its own.
        """

    def detect(self, jobs: Sequence[tuple[Any, Any]]) -> Sequence[Any]:
        """One result for each of `jobs`, in their order, or what its own `detect` would have raised.

        If it raises, all its frames fail.
        """


@dataclass(frozen=True, eq=False)
class Networks:
    """The networks of one model, compared by identity. One thread at a time uses each of them.

    An abandoned frame keeps its network until the frame's thread has ended.
    """

    whole: Any
    """For a frame while no other one is in progress; it may use all processors."""
    parallel: Sequence[Any] = ()
    """For frames of different cameras at the same time; they share the processors. Empty: one at a time."""
    batch: Batch | None = None
    """Runs frames that wait at the same time together, in `whole`; None: each runs alone."""
    weights_sha256: str = ""
    """Identifies the weights of the model; "" if they come from no file."""


class Pipeline(Protocol[AnyFrame, Result]):
    """Processes the frames of one camera, one at a time, in the inference threads."""

    @property
    def networks(self) -> Networks:
        """What may run a frame. Pipelines with the same model have the same ones."""

    def detect(self, frame: AnyFrame, network: Any) -> Result:
        """The result for `frame` from one of `networks`. Raises ImageError when the frame is unreadable."""

    def messages(self, result: Result) -> Iterator[Send]:
        """Compute what to publish of the result of `detect`, one message after the other.

        Each item sends one message and computes nothing. The frame may be abandoned between any two items;
        then the rest is never asked for.
        """
