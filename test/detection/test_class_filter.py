"""Names and indices of classes."""

from __future__ import annotations

import pytest

from yolov5_lifecycle.detection.class_filter import MAX_EXPLAINED, class_ids, class_thresholds
from yolov5_lifecycle.models.class_names import class_names_of

NAMES = ("person", "bicycle", "traffic light", "3", "person")


@pytest.mark.parametrize(
    ("entries", "ids"),
    [
        pytest.param([], None, id="empty-is-all"),
        pytest.param(["3"], {3}, id="a-name-that-looks-like-an-index"),
        pytest.param(["person"], {0, 4}, id="a-name-that-occurs-twice"),
        pytest.param(["traffic light", "0", "0"], {0, 2}, id="mixed-and-repeated"),
    ],
)
def test_entries_select_classes(entries: list[str], ids: set[int] | None) -> None:
    assert class_ids(entries, NAMES) == (None if ids is None else frozenset(ids))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(7, id="number"),
        pytest.param("", id="empty"),
        pytest.param(" cat: a\u00a0cat ", id="blanks and colon"),
        pytest.param("c\u200dat\x1b", id="escapes"),
    ],
)
def test_a_class_of_any_name_is_selected_by_what_is_shown_and_by_what_the_file_has(name: object) -> None:
    names = class_names_of(["dog", name, "7 dogs"], 3, 3)
    entries = [names[1], *([name] if isinstance(name, str) and name else [])]
    for entry in entries:
        assert class_ids([entry], names) == frozenset({1})
        assert class_thresholds([f"{entry}: 0.5"], names) == ((1, 0.5),)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        pytest.param(["persn"], "'persn' is not a class.*Did you mean 'person'", id="typo"),
        pytest.param(["5"], "index 5 is out of range.*0 to 4", id="index-too-large"),
        pytest.param(["-1"], "'-1' is not a class", id="negative-index"),
        pytest.param(["persn", "99"], "persn.*99", id="all-at-once"),
        pytest.param(
            ["9" * 5000],
            r"index 9+\.\.\. \(5000 characters\) is out of range.*0 to 4",
            id="index-of-5000-digits",
        ),
        pytest.param(["a\n\x1b[31m"], r"'a \?\[31m' is not a class", id="control-characters"),
    ],
)
def test_an_entry_that_the_model_does_not_have_is_refused(entries: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        class_ids(entries, NAMES)


def test_unknown_entries_that_are_not_explained_are_counted() -> None:
    with pytest.raises(ValueError, match="is not a class") as refusal:
        class_ids([f"xyz{number}" for number in range(MAX_EXPLAINED + 1)], ["person"])
    explained = [f"'xyz{number}' is not a class of the model (person)." for number in range(MAX_EXPLAINED)]
    assert str(refusal.value) == f"{' '.join(explained)} 1 more entries are not classes of the model either."
    with pytest.raises(ValueError, match=r"the model \(person\)\.$"):
        class_ids([f"xyz{number}" for number in range(MAX_EXPLAINED)], ["person"])


@pytest.mark.parametrize(
    ("entries", "thresholds"),
    [
        pytest.param([], (), id="empty"),
        pytest.param(["2: 0.5", "1: 1"], ((1, 1.0), (2, 0.5)), id="indices"),
        pytest.param(["person: 0"], ((0, 0.0), (4, 0.0)), id="a-name-that-occurs-twice"),
        pytest.param([" traffic light :.5e-1 "], ((2, 0.05),), id="space"),
    ],
)
def test_entries_give_classes_thresholds(
    entries: list[str], thresholds: tuple[tuple[int, float], ...]
) -> None:
    assert class_thresholds(entries, NAMES) == thresholds


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        pytest.param(["bicycle: 0.5", "1: 0.5"], "'bicycle' and '1' are the same class", id="name-and-index"),
        pytest.param(["1: 0.5", "01: 0.2"], "'1' and '01' are the same class", id="two-indices"),
    ],
)
def test_a_threshold_of_a_class_that_the_model_does_not_have_is_refused(
    entries: list[str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        class_thresholds(entries, NAMES)
