"""Suggestions are good for what people mistype, and bounded for everything else."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, repeat

import pytest

from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME
from yolov5_lifecycle.settings.suggestion import MAX_WORD_LENGTH, most_similar, nearest


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


def test_of_names_without_end_the_first_are_compared() -> None:
    assert nearest("persn", chain(["person"], repeat("parson"))) == "person"
