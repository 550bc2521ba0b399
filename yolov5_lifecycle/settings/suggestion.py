"""Suggestions for misspelled names: `Did you mean ...?`."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher, get_close_matches
from itertools import islice

MAX_UNKNOWN = 20
"""Of many unknown names, those that are told, with a similar one that is sought in 1 ms each."""
MAX_WORD_LENGTH = 100
"""Longer words get no suggestion and are never suggested."""
MAX_CHARACTERS = 20_000
"""Of the known names, as long as the word: class names come from weights files, and this takes up to 1 s."""


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The known word most similar to `word`, or None if none is close; of very many, only the first count."""
    if len(word) > MAX_WORD_LENGTH:
        return None
    first = islice(known, MAX_CHARACTERS // (len(word) + 1))
    names = {name.casefold(): name for name in first if len(name) <= MAX_WORD_LENGTH}
    match = get_close_matches(word.casefold(), names, n=1)
    return names[match[0]] if match else None


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` Did you mean 'x'?` with its leading space, or an empty string."""
    match = nearest(word, known)
    return f" Did you mean '{match}'?" if match else ""


def most_similar(word: str, known: Iterable[str]) -> list[str]:
    """`known`, sorted by similarity to `word`, most similar first."""
    return sorted(known, key=lambda name: -SequenceMatcher(None, word, name).ratio())
