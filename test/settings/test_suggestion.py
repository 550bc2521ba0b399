"""Suggestions are good for what people mistype, and bounded for everything else."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import SequenceMatcher

import pytest

from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME
from yolov5_lifecycle.settings.suggestion import (
    MAX_CHARACTER_PAIRS,
    MAX_CHARACTERS,
    MAX_WORD_LENGTH,
    most_similar,
    nearest,
)


class CountingMatcher(SequenceMatcher[str]):
    """Counts the letters and pairs of letters that it compares."""

    def __init__(self) -> None:
        self.letters = 0
        self.pairs = 0
        self._lengths = [0, 0]
        super().__init__()

    def set_seq1(self, a: Sequence[str]) -> None:
        self._lengths[0] = len(a)
        super().set_seq1(a)

    def set_seq2(self, b: Sequence[str]) -> None:
        self._lengths[1] = len(b)
        super().set_seq2(b)

    def quick_ratio(self) -> float:
        self.letters += self._lengths[0]
        return super().quick_ratio()

    def ratio(self) -> float:
        self.pairs += self._lengths[0] * self._lengths[1]
        return super().ratio()


@pytest.mark.parametrize(
    ("word", "known", "meant"),
    [
        pytest.param("persn", ["person", "parson"], "person", id="missing-letter"),
        pytest.param("PERSON", ["person"], "person", id="capitals"),
        pytest.param("x", ["person"], None, id="nothing-is-close"),
        pytest.param("", ["person", ""], "", id="empty-word"),
        pytest.param("person", [], None, id="nothing-is-known"),
        pytest.param("class 500x", [f"class {number}" for number in range(1000)], "class 500", id="many"),
        pytest.param("a" * (MAX_WORD_LENGTH + 1), ["a" * MAX_WORD_LENGTH], None, id="endless-word"),
        pytest.param("abc", ["a" * 1_000_000, "abd"], "abd", id="endless-candidate"),
    ],
)
def test_the_nearest_word_is_found(word: str, known: Sequence[str], meant: str | None) -> None:
    assert nearest(word, known) == meant


@pytest.mark.parametrize("name", SETTINGS_BY_NAME)
def test_every_setting_is_found_by_a_name_without_one_letter(name: str) -> None:
    middle = len(name) // 2
    assert nearest(name[:middle] + name[middle + 1 :], SETTINGS_BY_NAME) == name


def test_names_are_sorted_by_their_similarity() -> None:
    names = ["/joint_states", "/camera/image", "/camera/image_raw", ""]
    assert most_similar("/image_raw", names) == ["/camera/image_raw", "/camera/image", "/joint_states", ""]
    assert most_similar("/image_raw", []) == []


@pytest.mark.parametrize("length", [5, 50, MAX_WORD_LENGTH, 195, 5000])
def test_the_work_is_bounded_whatever_is_compared(length: int) -> None:
    matcher = CountingMatcher()
    known = [("ab" * length)[: length - 3] + f"{number:03}" for number in range(1000)]
    nearest(("ba" * length)[:length], known, matcher=matcher)
    assert matcher.letters <= MAX_CHARACTERS
    assert matcher.pairs <= MAX_CHARACTER_PAIRS
