"""What the reasons for an image are worth."""

from __future__ import annotations

from yolov5_lifecycle.collecting.reason import Reason, Why, value_of


def test_an_image_is_worth_what_its_best_reason_is() -> None:
    doubt, novelty = {Reason.UNCERTAIN: Why("", 0.5)}, {Reason.NOVEL: Why("")}
    assert value_of(doubt) > value_of(novelty)
    assert value_of({**doubt, **novelty}) == value_of(doubt)


def test_what_somebody_asked_for_is_worth_more_than_all_others() -> None:
    others: dict[Reason, Why] = {
        reason: Why("") for reason in Reason if reason not in (Reason.REQUESTED, Reason.CLASS)
    }
    assert value_of({Reason.CLASS: Why("")}) > value_of(others)
    assert value_of({Reason.REQUESTED: Why("")}) > value_of({**others, Reason.CLASS: Why("")})
