"""What is written of a frame: labels that `evaluate` reads back, and an image without what must not be."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.candidates import CAT, SIZE_HW, candidate, found, rules

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.evaluation.yolo_folder import parsed_labels
from yolov5_lifecycle.images.image import ColourImage

HEIGHT, WIDTH = SIZE_HW
BOXES = [(10, 5, 30, 40), (-20, -5, 8, 20), (50, 30, 90, 60), (70, 10, 80, 20), (5, 5, 5, 20)]
VISIBLE = [(10, 5, 30, 40), (0, 0, 8, 20), (50, 30, WIDTH, HEIGHT)]
SEVERAL = found(*[("dog", 0.9, box) for box in BOXES])


def label_text(detections: Detections, class_ids: list[int], *, segments: bool = False) -> str:
    return candidate(detections=detections, rules=rules(segments=segments)).labels(class_ids)


@pytest.mark.parametrize("segments", [False, True], ids=["boxes", "polygons without a mask"])
def test_labels_are_the_boxes_within_the_image(segments: bool) -> None:
    labels = parsed_labels(label_text(SEVERAL, [3, 4], segments=segments), 5)
    expected = np.array(VISIBLE) / (WIDTH, HEIGHT, WIDTH, HEIGHT)
    np.testing.assert_allclose(labels.xyxy, expected, atol=1e-5)
    assert labels.class_ids.tolist() == [4, 4, 4]


def masked(values: float) -> Detections:
    """A cat whose mask is the left half of its box if `values` is positive, nothing if it is negative."""
    prototypes = np.full((1, HEIGHT, WIDTH), -1, np.float32)
    prototypes[0, :, : WIDTH // 2] = values
    box = found(("cat", 0.9, (WIDTH // 4, 10, 3 * WIDTH // 4, 30)))
    return replace(box, masks=Masks(prototypes, np.full((1, 1), 9, np.float32), SIZE_HW))


@pytest.mark.parametrize(
    ("values", "right"), [(1.0, WIDTH // 2), (-1.0, 3 * WIDTH // 4)], ids=["outline", "without a mask"]
)
def test_a_polygon_is_the_outline_of_the_mask_or_the_corners_of_the_box(values: float, right: int) -> None:
    text = label_text(masked(values), [0, 1], segments=True)
    corners = parsed_labels(text, 2).xyxy[0] * (WIDTH, HEIGHT, WIDTH, HEIGHT)
    assert corners.tolist() == pytest.approx((WIDTH // 4, 10, right, 30), abs=1.01)


def test_a_record_has_the_tracks_of_its_objects() -> None:
    two = found(("dog", 0.9, BOXES[0]), ("cat", 0.5, BOXES[1]))
    frame = candidate(detections=replace(two, track_ids=("7", "")))
    objects = frame.record("images/a/000001.jpg", frame.reasons).objects
    assert [(each.class_name, each.track_id) for each in objects] == [("dog", "7"), ("cat", "")]


def test_a_jpeg_is_kept_as_it_was_received() -> None:
    jpeg = cv2.imencode(".jpg", candidate().image.pixels)[1].reshape(-1)
    assert candidate(received_jpeg=jpeg).jpeg() == jpeg.tobytes()


def test_blank_regions_are_black_and_their_objects_are_not_labelled() -> None:
    white = ColourImage(np.full((48, 64, 3), 255, np.uint8), "rgb")
    received = cv2.imencode(".jpg", white.pixels)[1].reshape(-1)
    left = rules(blank_regions=("0,0 0.5,0 0.5,1 0,1",))
    frame = candidate(image=white, received_jpeg=received, rules=left)
    pixels = cv2.imdecode(np.frombuffer(frame.jpeg(), np.uint8), cv2.IMREAD_COLOR)
    assert pixels[:, :30].max() < 20
    assert pixels[:, 34:].min() > 235
    assert white.pixels.min() == 255
    assert frame.shades.max() > frame.shades.min()  # of what is stored
    assert len(CAT) == 1
    assert frame.record("images/a/000001.jpg", frame.reasons).objects == ()
    assert frame.labels([0, 1]) == ""
