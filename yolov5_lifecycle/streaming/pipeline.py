"""Interface of the code that the worker runs on frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

Frame = TypeVar("Frame")
AnyFrame = TypeVar("AnyFrame", contravariant=True)
Result = TypeVar("Result")

Send = Callable[[], object]
"""Sends one finished message."""


@dataclass(frozen=True, eq=False)
class Networks:
    """The networks of one model, compared by identity. One thread at a time uses each of them.

    That of an abandoned frame is not used again.
    """

    whole: Any
    """For a frame while no other one is in progress; it may use all processors."""
    parallel: Sequence[Any] = ()
    """For frames of different cameras at the same time; they share the processors. Empty: one at a time."""
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
