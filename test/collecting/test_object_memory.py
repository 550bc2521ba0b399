"""Which objects come, go, come back or change their class between images."""

from __future__ import annotations

import pytest
from support.candidates import CLASS_NAMES, SIZE_HW, found

from yolov5_lifecycle.collecting.object_memory import MAX_OBJECTS, Change, ObjectMemory
from yolov5_lifecycle.collecting.reason import Reason
from yolov5_lifecycle.detection.detections import Detections

INSIDE, BESIDE, AT_BORDER = (20, 15, 40, 35), (22, 16, 42, 36), (0, 15, 20, 35)
ELSEWHERE = (45, 5, 60, 15)
NOTHING = found()


def cat(box: tuple[float, ...] = INSIDE, track: str = "") -> Detections:
    return found(("cat", 0.9, box), ids=(track,) if track else ())


def dog(box: tuple[float, ...] = INSIDE, track: str = "") -> Detections:
    return found(("dog", 0.9, box), ids=(track,) if track else ())


def changes(*images: Detections) -> list[list[Change]]:
    memory = ObjectMemory()
    return [memory.changes(image, SIZE_HW, CLASS_NAMES) for image in images]


@pytest.mark.parametrize(
    ("images", "last"),
    [
        pytest.param([cat()], [], id="the first image"),
        pytest.param([cat(), cat()], [], id="nothing happens"),
        pytest.param([cat(), cat(BESIDE)], [], id="it moves"),
        pytest.param([NOTHING, cat()], [(Reason.APPEARED, "cat came")], id="it comes out of nothing"),
        pytest.param([NOTHING, cat(AT_BORDER)], [], id="it comes across the border"),
        pytest.param([cat(), NOTHING], [], id="it is missing once"),
        pytest.param([cat(), *[NOTHING] * 3], [(Reason.APPEARED, "cat went")], id="it goes"),
        pytest.param([cat(), *[NOTHING] * 4], [], id="it went before"),
        pytest.param([cat(AT_BORDER), *[NOTHING] * 3], [], id="it goes across the border"),
        pytest.param(
            [cat(), NOTHING, NOTHING, cat()],
            [(Reason.UNSTEADY, "cat was lost for 2 images")],
            id="it is lost and found",
        ),
        pytest.param(
            [cat(), *[NOTHING] * 31, cat()], [(Reason.APPEARED, "cat came")], id="it was long forgotten"
        ),
        pytest.param([cat(), dog()], [(Reason.UNSTEADY, "cat became dog")], id="another class"),
        pytest.param(
            [cat(track="7"), cat(ELSEWHERE, track="7")], [], id="its track continues in another place"
        ),
        pytest.param(
            [cat(track="7"), cat(track="8")], [(Reason.APPEARED, "cat came")], id="another track in its place"
        ),
        pytest.param(
            [cat(track="7"), NOTHING, dog(track="7")],
            [(Reason.UNSTEADY, "cat became dog")],
            id="its track changes the class",
        ),
    ],
)
def test_a_change_is_noticed(images: list[Detections], last: list[Change]) -> None:
    assert changes(*images)[-1] == last


def test_a_detection_that_the_tracker_does_not_know_yet_is_no_change() -> None:
    unknown = found(("cat", 0.9, INSIDE), ids=("",))
    assert changes(NOTHING, unknown, unknown) == [[], [], []]


def test_two_objects_that_overlap_stay_two() -> None:
    two = found(("cat", 0.9, INSIDE), ("dog", 0.8, BESIDE))
    exchanged = found(("dog", 0.9, BESIDE), ("cat", 0.8, INSIDE))
    assert changes(two, exchanged, two) == [[], [], []]


def test_of_very_many_objects_the_best_are_compared() -> None:
    many = found(*[("cat", 0.9, INSIDE)] * MAX_OBJECTS, ("dog", 0.5, ELSEWHERE))
    few = found(*[("cat", 0.9, INSIDE)] * MAX_OBJECTS)
    assert changes(few, many, few) == [[], [], []]
