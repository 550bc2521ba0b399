"""Topics and messages as the files of a recording store them, whatever their format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

CDR = "cdr"
"""The encoding of ROS 2."""
MAX_MESSAGE_BYTES = 256 << 20
"""Of a message that is read: an RGB image of 89 megapixels."""


class StorageError(ValueError):
    """A file of a recording that is not read; the message says what it has, and what to do."""


class DamageError(StorageError):
    """A file that is not as its format demands; it may be repaired."""


@dataclass(frozen=True)
class StoredTopic:
    """A topic in one file."""

    name: str
    type_name: str
    encoding: str
    count: int = 0
    """Messages on it."""

    def with_count(self, count: int) -> StoredTopic:
        return replace(self, count=count)


class Storage(Protocol):
    """An open file of a recording."""

    @property
    def topics(self) -> Sequence[StoredTopic]:
        """Topics of any type and encoding; several may have one name."""

    def messages(self, name: str, type_name: str) -> Iterator[tuple[int, bytes | None]]:
        """Time of recording in nanoseconds and content, None if larger than MAX_MESSAGE_BYTES.

        In the order of the file; raises StorageError, and exceptions of any kind if it is damaged.
        """

    def close(self) -> None:
        """Release the file; calls after the first have no effect."""
