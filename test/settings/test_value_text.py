"""Values in messages are spelled as a parameter file spells them, and are short."""

from __future__ import annotations

import math
from array import array

import pytest

from yolov5_lifecycle.settings.parameter_file import parameter_value
from yolov5_lifecycle.settings.settings import SETTINGS
from yolov5_lifecycle.settings.value_text import MAX_SHOWN, shown_value, value_text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "true"),
        (False, "false"),
        (None, "null"),
        (3, "3"),
        (0.25, "0.25"),
        (math.inf, ".inf"),
        (-math.inf, "-.inf"),
        (math.nan, ".nan"),
        ("auto", "'auto'"),
        ("true", "'true'"),
        ((), "[]"),
        (("front", "rear"), "['front', 'rear']"),
        ([True, False], "[true, false]"),
        (array("d", [0.5, math.inf]), "[0.5, .inf]"),
    ],
    ids=str,
)
def test_a_value_is_spelled_as_in_yaml(value: object, text: str) -> None:
    assert value_text(value) == text


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.name)
def test_ros_reads_the_text_of_a_default_as_the_default(setting: object) -> None:
    default = setting.default  # type: ignore[attr-defined]
    assert parameter_value(value_text(default)) == (list(default) if isinstance(default, tuple) else default)


@pytest.mark.parametrize(
    "value", ["a" * 10_000_000, ["ab"] * 1_000_000, ("a" * 1_000_000,) * 1000], ids=["string", "list", "both"]
)
def test_a_long_value_is_cut(value: object) -> None:
    assert len(shown_value(value)) == MAX_SHOWN
    assert shown_value(value).endswith("...")
