"""What the benchmark of masks measures, and which share of the forward pass it compares with its goal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.random_model import TINY_SEGMENT, random_model

from benchmark.masks import COUNTS, FORWARD, PROTOTYPES, calls, goal, measured_ms, of_objects, random_boxes
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors

SIZE_HW = (96, 128)


@pytest.mark.long
def test_every_call_is_measured_in_every_turn(tmp_path: Path) -> None:
    path = tmp_path / "segment.safetensors"
    write_safetensors(random_model(1, TINY_SEGMENT), path)
    taken_ms = measured_ms(calls(path, SIZE_HW), turns=2)
    assert {name: len(times_ms) for name, times_ms in taken_ms.items()} == dict.fromkeys(
        (FORWARD, PROTOTYPES, *map(of_objects, COUNTS)), 2
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
