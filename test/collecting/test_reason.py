"""What the reasons for an image are worth."""

from __future__ import annotations

from yolov5_lifecycle.collecting.reason import MAX_OBJECTS, Reason, Why, value_of


def test_an_image_with_more_doubts_is_worth_more_up_to_a_bound() -> None:
    values = [value_of({Reason.UNCERTAIN: Why("", count)}) for count in (1, 3, MAX_OBJECTS, 1000)]
    assert values == [2, 6, 20, 20]


def test_the_values_of_several_reasons_add_up_and_a_request_is_worth_more_than_all_others() -> None:
    others: dict[Reason, Why] = {reason: Why("", 1000) for reason in Reason if reason is not Reason.REQUESTED}
    assert value_of(others) > value_of({Reason.CLASS: Why("", 1000)})
    assert value_of({Reason.REQUESTED: Why("")}) > value_of(others)
