"""Messages spell values as a parameter file does, and suggest what people mean; both are bounded."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from itertools import chain, repeat

import pytest

from yolov5_lifecycle.settings.parameter_file import parameter_value
from yolov5_lifecycle.settings.settings import SETTINGS, SETTINGS_BY_NAME
from yolov5_lifecycle.settings.suggestion import MAX_WORD_LENGTH, most_similar, nearest
from yolov5_lifecycle.settings.value_text import MAX_SHOWN, shown_value, value_text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "true"),
        (None, "null"),
        (-math.inf, "-.inf"),
        (math.nan, ".nan"),
        ("true", "'true'"),
        ((), "[]"),
        (("front", "rear"), "['front', 'rear']"),
        (array("d", [0.5, math.inf]), "[0.5, .inf]"),
    ],
    ids=str,
)
def test_a_value_is_spelled_as_in_yaml(value: object, text: str) -> None:
    assert value_text(value) == text


def test_ros_reads_the_text_of_a_default_as_the_default() -> None:
    for default in (setting.default for setting in SETTINGS):
        read = list(default) if isinstance(default, tuple) else default
        assert parameter_value(value_text(default)) == read


@pytest.mark.parametrize("value", ["a" * 1_000_000, ("a" * 1_000_000,) * 1000], ids=["string", "list"])
def test_a_long_value_is_cut(value: object) -> None:
    assert len(shown_value(value)) == MAX_SHOWN
    assert shown_value(value).endswith("...")


@pytest.mark.parametrize(
    ("word", "known", "meant"),
    [
        pytest.param("PERSN", ["person", "parson"], "person", id="missing-letter"),
        pytest.param("x", ["person"], None, id="nothing-is-close"),
        pytest.param("", ["person", ""], "", id="empty-word"),
        pytest.param("person", [], None, id="nothing-is-known"),
        pytest.param("a" * (MAX_WORD_LENGTH + 1), ["a" * MAX_WORD_LENGTH], None, id="endless-word"),
        pytest.param("abc", ["a" * 1_000_000, "abd"], "abd", id="endless-candidate"),
    ],
)
def test_the_nearest_word_is_found(word: str, known: Sequence[str], meant: str | None) -> None:
    assert nearest(word, known) == meant


def test_every_setting_is_found_by_a_name_without_one_letter() -> None:
    for name in SETTINGS_BY_NAME:
        middle = len(name) // 2
        assert nearest(name[:middle] + name[middle + 1 :], SETTINGS_BY_NAME) == name


def test_names_are_sorted_by_their_similarity() -> None:
    names = ["/joint_states", "/camera/image", "/camera/image_raw", ""]
    assert most_similar("/image_raw", names) == ["/camera/image_raw", "/camera/image", "/joint_states", ""]


def test_of_names_without_end_the_first_are_compared() -> None:
    assert nearest("persn", chain(["person"], repeat("parson"))) == "person"
