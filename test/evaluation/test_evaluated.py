"""Classes of data sets and models are compared by name, whatever their ids."""

from __future__ import annotations

import numpy as np
import pytest

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.evaluation.ground_truth import Boxes, DataError
from yolov5_lifecycle.evaluation.matching import MAX_DETECTIONS, EvaluatedClasses

DATA = ("dog", "unicorn", "cat", "bird")
FIRST = (("cat", "dog", "car", "bird"), None)
SECOND = (("bird", "cat", "dog"), frozenset({1, 2}))
BOX = (1.0, 2.0, 3.0, 4.0)


def test_two_models_are_evaluated_in_the_classes_that_both_know_and_want() -> None:
    classes = EvaluatedClasses.shared(DATA, [FIRST, SECOND])
    assert classes.names == ("dog", "cat")
    assert classes.left_out == ("unicorn", "bird")
    truth = classes.truth(Boxes.of([BOX] * 4, [0, 1, 2, 3]))
    assert [classes.names[class_id] for class_id in truth.class_ids] == ["dog", "cat"]
    for model, (names, _) in enumerate((FIRST, SECOND)):
        ids = np.arange(len(names), dtype=np.int64)
        boxes = np.tile(np.array(BOX, np.float32), (len(ids), 1))
        found = classes.found(Detections(boxes, np.linspace(1, 0.5, len(ids), dtype=np.float32), ids), model)
        expected = [name for name in names if name in classes.names]
        assert [classes.names[class_id] for class_id in found.class_ids] == expected
        assert len(found) == len(expected)


def test_only_the_best_detections_of_a_class_count() -> None:
    count = MAX_DETECTIONS + 5
    ids = np.zeros(2 * count, np.int64)
    ids[1::2] = 1
    boxes = np.tile(np.array(BOX, np.float32), (2 * count, 1))
    many = Detections(boxes, np.linspace(1, 0.5, 2 * count, dtype=np.float32), ids)
    kept = EvaluatedClasses.shared(None, [(("cat", "dog"), None)]).found(many, 0)
    np.testing.assert_array_equal(kept.scores, many.scores[: 2 * MAX_DETECTIONS])


def test_without_names_the_ids_are_those_of_the_model() -> None:
    classes = EvaluatedClasses.shared(None, [FIRST])
    assert classes.names == FIRST[0]
    with pytest.raises(DataError, match="expected a class from 0 to 3, found 4"):
        classes.truth(Boxes.of([BOX], [4]))
    assert len(classes.truth(Boxes.of([], []))) == 0


@pytest.mark.parametrize(
    ("names", "told"),
    [
        pytest.param(("Dog",), "Did you mean 'dog'?", id="other spelling"),
        pytest.param((), "The data set has the classes (none)", id="no names"),
        pytest.param(tuple(f"class {number}" for number in range(20)), "class 9, ...", id="many names"),
    ],
)
def test_nothing_in_common_is_refused_with_both_lists(names: tuple[str, ...], told: str) -> None:
    with pytest.raises(DataError) as refused:
        EvaluatedClasses.shared(names, [FIRST])
    assert told in str(refused.value)
    assert "cat, dog, car, bird" in str(refused.value)
