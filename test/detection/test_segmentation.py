"""A detector whose model segments: masks of what it reports, computed only on request."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from support.random_model import CLASS_NAMES
from support.scripted_runtime import ScriptedRuntime

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.runtimes.runtime import InferenceError

SIZE_HW = (64, 96)
IMAGE = ColourImage(np.zeros((*SIZE_HW, 3), np.uint8), "rgb")
WITH_MASKS = Selection(with_masks=True)
LEFT, RIGHT = (16, 32, 32, 64), (80, 32, 32, 64)  # cx, cy, w, h
UPPER = np.zeros((2, 16, 24), np.float32)
UPPER[0, :8], UPPER[0, 8:] = 9, -9  # the first prototype is in the upper half, the second everywhere
UPPER[1] = 9


class CountedPrototypes:
    """`UPPER`, and how often it was computed."""

    def __init__(self, prototypes: NDArray[np.float32] = UPPER) -> None:
        self._prototypes = prototypes
        self.count = 0

    def __call__(self) -> NDArray[np.float32]:
        self.count += 1
        return self._prototypes


def row(box_cxcywh: tuple[int, ...], score: float, class_id: int, *coefficients: float) -> list[float]:
    scores = [score if index == class_id else 0.0 for index in range(len(CLASS_NAMES))]
    return [*box_cxcywh, 1.0, *scores, *coefficients]


def detector_of(
    *rows: list[float], prototypes: Callable[[], NDArray[np.float32]] | None = None
) -> tuple[Detector, ScriptedRuntime]:
    raw = np.array(rows, np.float32).reshape(-1, 5 + len(CLASS_NAMES) + 2)
    runtime = ScriptedRuntime(lambda: raw)
    runtime.compute_prototypes = prototypes or CountedPrototypes()
    detector = Detector(runtime, class_names=CLASS_NAMES, image_size=96, stride=32, mask_coefficients=2)
    return detector, runtime


def test_each_detection_has_the_mask_of_its_own_coefficients() -> None:
    # The second row is not reported, the last lies outside the image.
    detector, _ = detector_of(
        row(LEFT, 0.5, 1, 1, 0),
        row(LEFT, 0.1, 0, 9, 9),
        row(RIGHT, 0.9, 2, 0, 1),
        row((200, 300, 8, 8), 0.8, 0, 9, 9),
    )
    found = detector.detect(IMAGE, WITH_MASKS)
    assert found.class_ids.tolist() == [2, 1]
    labels = found.label_image()
    assert labels is not None
    expected = np.zeros(SIZE_HW)
    expected[:, 64:] = 1
    expected[:32, :32] = 2
    np.testing.assert_array_equal(labels, expected)


@pytest.mark.parametrize(
    ("scores", "selection", "computed"),
    [
        pytest.param((0.9, 0.8), WITH_MASKS, 1, id="once for all detections"),
        pytest.param((0.9,), Selection(), 0, id="not asked for"),
        pytest.param((0.1,), WITH_MASKS, 0, id="nothing detected"),
    ],
)
def test_prototypes_are_computed_where_they_are_needed(
    scores: tuple[float, ...], selection: Selection, computed: int
) -> None:
    prototypes = CountedPrototypes()
    boxes = (LEFT, RIGHT)
    rows = [row(box, score, 0, 1, 1) for box, score in zip(boxes, scores, strict=False)]
    detector, _ = detector_of(*rows, prototypes=prototypes)
    found = detector.detect(IMAGE, selection)
    assert prototypes.count == computed
    labels = found.label_image()
    assert (labels is not None) == selection.with_masks
    assert labels is None or labels.shape == SIZE_HW
    assert labels is None or set(np.unique(labels)) - {0} == set(range(1, len(found) + 1))


@pytest.mark.parametrize(
    "prototypes",
    [
        pytest.param(np.full_like(UPPER, np.nan), id="no numbers"),
        pytest.param(np.ones((3, 16, 24), np.float32), id="more than coefficients"),
    ],
)
def test_prototypes_that_make_no_masks_are_an_error(prototypes: NDArray[np.float32]) -> None:
    detector, _ = detector_of(row(LEFT, 0.5, 1, 1, 0), prototypes=CountedPrototypes(prototypes))
    with pytest.raises(InferenceError, match="Expected 2 prototypes of masks"):
        detector.detect(IMAGE, WITH_MASKS)
    assert len(detector.detect(IMAGE, Selection())) == 1
