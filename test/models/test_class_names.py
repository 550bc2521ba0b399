"""Class names of any kind become text that is safe to show, and keep their index."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from yolov5_lifecycle.models.class_names import (
    MAX_NAME_LENGTH,
    ClassNamesError,
    class_names_of,
    safe_name,
)
from yolov5_lifecycle.printable import in_one_line

MOST = 50
FAMILY = "👩\u200d👩\u200d👧\u200d👦"
PERSIAN = "می\u200cشود"
NAMES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just("1")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        pytest.param(-1.5, "-1.5", id="decimal number"),
        pytest.param(True, "True", id="yes of YAML"),
        pytest.param(None, "class 1", id="nothing"),
        pytest.param(" \t\u00a0", "class 1", id="blanks only"),
        pytest.param("traffic\u00a0light", "traffic light", id="no-break space"),
        pytest.param(" traffic\r\n light\u3000", "traffic light", id="line break and blanks around"),
        pytest.param(FAMILY, FAMILY, id="family of emoji"),
        pytest.param("👨🏽\u200d🚀 🏳️\u200d🌈", "👨🏽\u200d🚀 🏳️\u200d🌈", id="emoji of several signs"),
        pytest.param(PERSIAN, PERSIAN, id="Persian"),
        pytest.param("自行车", "自行车", id="Chinese"),
        pytest.param("c\u200dat", r"c\u200dat", id="joiner that joins nothing"),
        pytest.param("\u202ecat", r"\u202ecat", id="written from right to left"),
        pytest.param("\x1b[31mcat\x07", r"\x1b[31mcat\x07", id="colours of a terminal"),
        pytest.param("\ud800", r"\ud800", id="half a character"),
        pytest.param(r"a\x1bb", r"a\x1bb", id="backslash"),
    ],
)
def test_a_name_is_text_that_is_safe_to_show(name: object, text: str) -> None:
    assert class_names_of(["cat", name, "dog"], 3, 3) == ("cat", text, "dog")
    assert in_one_line(text) == text


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        pytest.param({2: "cow", 0: "cat"}, ("cat", "class 1", "cow"), id="gap"),
        pytest.param({"0": "cat", "2": "cow", "1": "dog"}, ("cat", "dog", "cow"), id="texts"),
        pytest.param({0: "cat", "1": "dog", "02": "cow"}, ("cat", "dog", "cow"), id="both"),
        pytest.param(["item", "item", 1], ("item", "item", "1"), id="equal in a list"),
        pytest.param([1, "1", "cow"], ("1", "1", "cow"), id="number and text in a list"),
    ],
)
def test_names_keep_their_index(names: object, expected: tuple[str, ...]) -> None:
    assert class_names_of(names, 3, 3) == expected


def test_without_a_number_of_classes_the_largest_index_counts() -> None:
    assert class_names_of({0: "cat", 2: "cow"}, 0, MOST) == ("cat", "class 1", "cow")
    assert class_names_of({}, 0, MOST) == ()


@given(st.lists(NAMES, max_size=8))
def test_names_are_safe_and_safe_ones_are_left_alone(names: list[object]) -> None:
    try:
        texts = class_names_of(names, 0, MOST)
    except ClassNamesError:
        return
    assert all(in_one_line(text) == text and 0 < len(text) <= MAX_NAME_LENGTH for text in texts)
    assert len(texts) == len(names)
    assert class_names_of(list(texts), 0, MOST) == texts


def test_a_very_long_name_is_refused_before_it_is_worked_on() -> None:
    with pytest.raises(ClassNamesError, match="a class name of 4000000 characters, more than 200"):
        safe_name(" \x1b" * 2_000_000)
