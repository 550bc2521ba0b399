"""What the benchmark of masks measures, and which share of the forward pass it compares with its goal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.random_model import TINY_SEGMENT, random_model

from benchmark.mask_accuracy import EXACT, ROUNDED, WEIGHTS, boxes_of_yolov5, compared
from benchmark.masks import (
    COUNTS,
    DRAWING,
    FORWARD,
    MESSAGE,
    PROTOTYPES,
    calls,
    goal,
    measured_ms,
    of_objects,
    random_boxes,
)
from tools.shapes.evaluate import UNSEEN_SEED, stills
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.loaded_detector import load_detector

pytestmark = pytest.mark.long

SIZE_HW = (96, 128)


def test_every_call_is_measured_in_every_turn(tmp_path: Path) -> None:
    path = tmp_path / "segment.safetensors"
    write_safetensors(random_model(1, TINY_SEGMENT), path)
    taken_ms = measured_ms(calls(path, SIZE_HW), turns=2)
    assert {name: len(times_ms) for name, times_ms in taken_ms.items()} == dict.fromkeys(
        (FORWARD, PROTOTYPES, *map(of_objects, COUNTS), DRAWING, MESSAGE), 2
    )
    assert min(min(times_ms) for times_ms in taken_ms.values()) > 0


def test_a_model_without_masks_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "detect.safetensors"
    write_safetensors(random_model(1), path)
    with pytest.raises(ValueError, match="expected a model that segments"):
        calls(path, SIZE_HW)


def test_the_boxes_lie_in_the_image() -> None:
    boxes_xyxy = random_boxes(np.random.default_rng(0), 50, SIZE_HW)
    assert ((boxes_xyxy >= 0) & (boxes_xyxy <= (128, 96, 128, 96))).all()
    assert (boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]).min() > 4


def test_the_goal_is_a_share_of_the_whole_forward_pass() -> None:
    reached = goal({FORWARD: [10.0], PROTOTYPES: [6.0], of_objects(10): [4.0]})
    assert (reached.value, reached.is_reached) == (0.25, True)
    assert not goal({FORWARD: [10.0], PROTOTYPES: [6.0], of_objects(10): [4.1]}).is_reached


def test_masks_are_those_of_the_reference_with_the_same_boxes_and_others_with_rounded_ones() -> None:
    detector = load_detector(load_weights(WEIGHTS).model, device="cpu", image_size=320)
    shares = compared(detector, stills(UNSEEN_SEED, 8, (250, 350)))
    assert len(shares[EXACT]) > 10
    assert max(shares[EXACT]) < 0.0005 < max(shares[ROUNDED])


@pytest.mark.parametrize(
    ("size_hw", "largest"),
    [
        pytest.param((480, 640), 0.0, id="no padding"),
        pytest.param((500, 700), 0.75 * 700 / 640, id="odd padding"),
        pytest.param((1080, 1920), 0.0, id="even padding"),
    ],
)
def test_yolov5_maps_boxes_back_to_almost_the_same_place(size_hw: tuple[int, int], largest: float) -> None:
    letterbox = Letterbox.fit(size_hw, image_size=640, stride=32)
    boxes_xyxy = random_boxes(np.random.default_rng(0), 50, size_hw)
    moved = np.abs(boxes_of_yolov5(boxes_xyxy, letterbox) - boxes_xyxy).max()
    assert moved <= largest + 1e-3
    assert (moved > 0.1) == (largest > 0)
