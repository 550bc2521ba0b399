"""Suggestions for misspelled names: `Did you mean ...?`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from difflib import SequenceMatcher

MAX_SUGGESTIONS = 20
"""Of many unknown names in a file or at the start, those for which a similar one is sought, 1 ms each."""
MAX_WORD_LENGTH = 100
"""Longer words get no suggestion and are never suggested."""
MAX_CHARACTERS = 15_000
"""Total characters of the candidates that are compared by more than their length."""
MAX_CHARACTER_PAIRS = 10_000
"""Total character pairs of the candidates compared in full, which takes up to 0.5 us per pair."""
_CUTOFF = 0.6


def nearest(word: str, known: Iterable[str], *, matcher: SequenceMatcher[str] | None = None) -> str | None:
    """The known word most similar to `word`, or None if none is close.

    The work is bounded for any input: of very many or very long candidates only the most promising are
    compared. `matcher` compares two words; its sequences are replaced.
    """
    if len(word) > MAX_WORD_LENGTH:
        return None
    matcher = matcher or SequenceMatcher()
    matcher.set_seq2(word.casefold())
    best, found, pairs = _CUTOFF, None, 0
    for bound, folded, name in sorted(_promising(matcher, word, known), reverse=True):
        pairs += len(word) * len(folded)
        if bound < best or pairs > MAX_CHARACTER_PAIRS:
            break
        matcher.set_seq1(folded)
        if (ratio := matcher.ratio()) > best or (found is None and ratio == best):
            best, found = ratio, name
    return found


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` Did you mean 'x'?` with its leading space, or an empty string."""
    match = nearest(word, known)
    return f" Did you mean '{match}'?" if match else ""


def _promising(
    matcher: SequenceMatcher[str], word: str, known: Iterable[str]
) -> Iterator[tuple[float, str, str]]:
    """Upper bound of similarity, case-folded word and word, for each candidate that may be close."""
    characters = 0
    for name in known:
        # The ratio is 2 * matches / sum of lengths, and matches <= the length of the shorter word.
        if 2 * min(len(word), len(name)) < _CUTOFF * (len(word) + len(name)):
            continue
        folded = name.casefold()
        characters += len(folded)
        if characters > MAX_CHARACTERS:
            return
        matcher.set_seq1(folded)
        if (bound := matcher.quick_ratio()) >= _CUTOFF:
            yield bound, folded, name


def most_similar(word: str, known: Iterable[str]) -> list[str]:
    """`known`, sorted by similarity to `word`, most similar first."""
    return sorted(known, key=lambda name: -SequenceMatcher(None, word, name).ratio())
