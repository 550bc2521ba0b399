"""Labels as `evaluate` reads them back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.candidates import SIZE_HW, found

from yolov5_lifecycle.collecting.labels import label_text
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.evaluation.yolo_labels import parsed_labels

HEIGHT, WIDTH = SIZE_HW
BOXES = [(10, 5, 30, 40), (-20, -5, 8, 20), (50, 30, 90, 60), (70, 10, 80, 20), (5, 5, 5, 20)]
VISIBLE = [(10, 5, 30, 40), (0, 0, 8, 20), (50, 30, WIDTH, HEIGHT)]
SEVERAL = found(*[("dog", 0.9, box) for box in BOXES])


@pytest.mark.parametrize("as_polygons", [False, True], ids=["boxes", "polygons without a mask"])
def test_labels_are_the_boxes_within_the_image(as_polygons: bool) -> None:
    text = label_text(SEVERAL, SIZE_HW, [3, 4], as_polygons=as_polygons)
    labels = parsed_labels(text, 5)
    expected = np.array(VISIBLE) / (WIDTH, HEIGHT, WIDTH, HEIGHT)
    np.testing.assert_allclose(labels.boxes.xyxy, expected, atol=1e-5)
    assert labels.boxes.class_ids.tolist() == [4, 4, 4]


def test_without_objects_there_is_no_label() -> None:
    assert label_text(found(), SIZE_HW, [0, 1], as_polygons=False) == ""


def masked(values: float) -> Detections:
    """A cat whose mask is the left half of its box if `values` is positive, nothing if it is negative."""
    prototypes = np.full((1, HEIGHT, WIDTH), -1, np.float32)
    prototypes[0, :, : WIDTH // 2] = values
    box = found(("cat", 0.9, (WIDTH // 4, 10, 3 * WIDTH // 4, 30)))
    return replace(box, masks=Masks(prototypes, np.full((1, 1), 9, np.float32), SIZE_HW))


def test_a_polygon_is_the_outline_of_the_mask() -> None:
    text = label_text(masked(1.0), SIZE_HW, [0, 1], as_polygons=True)
    x1, y1, x2, y2 = parsed_labels(text, 2).boxes.xyxy[0] * (WIDTH, HEIGHT, WIDTH, HEIGHT)
    assert (x1, y1, x2, y2) == pytest.approx((WIDTH // 4, 10, WIDTH // 2, 30), abs=1.01)


def test_an_object_without_a_mask_has_the_corners_of_its_box() -> None:
    text = label_text(masked(-1.0), SIZE_HW, [0, 1], as_polygons=True)
    box = parsed_labels(text, 2).boxes.xyxy[0] * (WIDTH, HEIGHT, WIDTH, HEIGHT)
    assert box.tolist() == pytest.approx([WIDTH // 4, 10, 3 * WIDTH // 4, 30], abs=1e-3)
