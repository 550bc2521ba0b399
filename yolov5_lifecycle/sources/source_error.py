"""Error of an image source."""

from __future__ import annotations


class SourceError(ValueError):
    """A source that is missing, unreadable or lost; the message says which and what to do."""
