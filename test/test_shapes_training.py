"""The training of the embedded model: its images, its loss and how results are counted."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tools.shapes.evaluate import iou, tally
from tools.shapes.images import Batches, spoil
from tools.shapes.labelled_image import LabelledImage
from tools.shapes.loss import ciou, detection_loss, match
from tools.shapes.train import ARCHITECTURE
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.sources.scene import Truth

pytestmark = pytest.mark.long

NO_TARGETS = torch.empty(0, 6)


def _truth(*rows: tuple[int, tuple[float, ...]]) -> Truth:
    boxes = np.array([box for _, box in rows], np.float32).reshape(-1, 4)
    return Truth(boxes, np.array([class_id for class_id, _ in rows], np.int64))


def _image(*rows: tuple[int, tuple[float, ...]]) -> LabelledImage:
    return LabelledImage(np.zeros((64, 64, 3), np.uint8), _truth(*rows), np.zeros((64, 64), np.uint16))


def _detections(*rows: tuple[int, tuple[float, ...]]) -> Detections:
    truth = _truth(*rows)
    return Detections(truth.boxes_xyxy, np.linspace(0.9, 0.5, len(rows), dtype=np.float32), truth.class_ids)


def test_a_batch_depends_on_its_seed_and_number_alone() -> None:
    batch, same, other = Batches(1, 9)[3], Batches(1, 9)[3], Batches(1, 9)[4]
    assert torch.equal(batch.pixels, same.pixels)
    assert torch.equal(batch.targets, same.targets)
    assert not torch.equal(batch.targets, other.targets)


@pytest.mark.parametrize("index", range(6))
def test_the_targets_of_a_batch_lie_in_its_images(index: int) -> None:
    batch = Batches(2, 9)[index]
    count, _, height, width = batch.pixels.shape
    number, _, x, y, w, h = batch.targets.T
    assert batch.pixels.dtype == torch.uint8
    assert height % 32 == width % 32 == 0
    assert number.max() < count
    assert ((x - w / 2 > -1e-3) & (x + w / 2 < width + 1e-3)).all()
    assert ((y - h / 2 > -1e-3) & (y + h / 2 < height + 1e-3)).all()


def test_degrading_does_not_change_its_input() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    before = pixels.copy()
    spoilt = [spoil(np.random.default_rng(seed), pixels) for seed in range(30)]
    np.testing.assert_array_equal(pixels, before)
    assert all(image.shape == pixels.shape and image.dtype == np.uint8 for image in spoilt)
    assert sum(not np.array_equal(image, pixels) for image in spoilt) > 20


def test_the_ciou_of_a_box_with_itself_is_one() -> None:
    boxes = torch.tensor([[5.0, 6.0, 3.0, 2.0], [0.1, -0.4, 9.0, 0.5]])
    torch.testing.assert_close(ciou(boxes, boxes), torch.ones(2))


def test_the_ciou_of_boxes_of_one_shape_is_the_iou_less_the_distance_of_centres() -> None:
    boxes, others = torch.tensor([[1.0, 1.0, 2.0, 2.0]]), torch.tensor([[2.0, 1.0, 2.0, 2.0]])
    torch.testing.assert_close(ciou(boxes, others), torch.tensor([1 / 3 - 1 / (3**2 + 2**2)]))


def test_the_ciou_of_concentric_boxes_counts_the_difference_of_aspect() -> None:
    boxes, others = torch.tensor([[0.0, 0.0, 2.0, 1.0]]), torch.tensor([[0.0, 0.0, 1.0, 2.0]])
    aspect = 4 / math.pi**2 * (math.atan(2) - math.atan(0.5)) ** 2
    expected = 1 / 3 - aspect**2 / (1 - 1 / 3 + aspect)
    torch.testing.assert_close(ciou(boxes, others), torch.tensor([expected]))


def test_every_match_is_in_the_grid_and_within_reach_of_its_cell_and_anchor() -> None:
    batch = Batches(3, 9)[0]
    stride, grid_hw = 16, (batch.pixels.shape[2] // 16, batch.pixels.shape[3] // 16)
    anchors_wh = torch.tensor(ARCHITECTURE.anchors_px[1]) / stride
    matches = match(batch.targets, anchors_wh, stride=stride, grid_hw=grid_hw)
    assert len(matches.rows) > 0
    assert ((matches.rows >= 0) & (matches.rows < grid_hw[0])).all()
    assert ((matches.columns >= 0) & (matches.columns < grid_hw[1])).all()
    assert ((matches.boxes[:, :2] >= -0.5) & (matches.boxes[:, :2] <= 1.5)).all()
    ratio = matches.boxes[:, 2:] / matches.anchors_wh
    assert (torch.maximum(ratio, 1 / ratio) < 4).all()


@pytest.mark.parametrize(
    ("centre_px", "cells"),
    [
        pytest.param((18.0, 19.0), {(2, 2), (1, 2), (2, 1)}, id="upper left half"),
        pytest.param((22.0, 23.0), {(2, 2), (3, 2), (2, 3)}, id="lower right half"),
        pytest.param((2.0, 3.0), {(0, 0)}, id="corner of the image"),
    ],
)
def test_the_cell_of_the_centre_and_its_nearest_neighbours_answer(
    centre_px: tuple[float, float], cells: set[tuple[int, int]]
) -> None:
    target = torch.tensor([[0, 1, *centre_px, 25.0, 25.0]])
    matches = match(target, torch.tensor([[3.0, 3.0]]), stride=8, grid_hw=(8, 8))
    assert set(zip(matches.columns.tolist(), matches.rows.tolist(), strict=True)) == cells


def test_without_targets_only_objectness_is_to_be_learnt() -> None:
    logits = [torch.full((1, 3, size, size, 9), -20.0) for size in (8, 4, 2)]
    assert detection_loss(logits, NO_TARGETS, ARCHITECTURE).item() == pytest.approx(0, abs=1e-6)


def test_learning_lowers_the_loss() -> None:
    torch.manual_seed(0)
    network = Network(ARCHITECTURE)
    batch = Batches(4, 9)[1]
    pixels = batch.pixels[:2].float() / 255
    targets = batch.targets[batch.targets[:, 0] < 2]
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(12):
        loss = detection_loss(network.heads(pixels), targets, ARCHITECTURE)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert len(targets) > 0
    assert losses[-1] < 0.8 * losses[0]


def test_iou_is_that_of_hand_computed_boxes() -> None:
    boxes = np.array([[0, 0, 2, 2]], np.float32)
    others = np.array([[0, 0, 2, 2], [1, 0, 3, 2], [5, 5, 6, 6]], np.float32)
    np.testing.assert_allclose(iou(boxes, others), [[1, 1 / 3, 0]], rtol=1e-6)


BOX, SHIFTED_BOX, FAR_BOX = (0, 0, 10, 10), (1, 0, 11, 10), (50, 50, 60, 60)


@pytest.mark.parametrize(
    ("detections", "truth", "right", "wrong", "missed"),
    [
        pytest.param([], [], 0, 0, 0, id="nothing"),
        pytest.param([], [(0, BOX)], 0, 0, 1, id="nothing found"),
        pytest.param([(0, BOX)], [], 0, 1, 0, id="nothing to find"),
        pytest.param([(0, SHIFTED_BOX)], [(0, BOX)], 1, 0, 0, id="found"),
        pytest.param([(0, BOX), (0, SHIFTED_BOX)], [(0, BOX)], 1, 1, 0, id="found twice"),
        pytest.param([(1, BOX)], [(0, BOX)], 0, 1, 1, id="another class"),
        pytest.param([(0, FAR_BOX)], [(0, BOX)], 0, 1, 1, id="elsewhere"),
        pytest.param([(0, BOX), (1, FAR_BOX)], [(1, FAR_BOX), (0, BOX)], 2, 0, 0, id="another sequence"),
    ],
)
def test_detections_are_counted_against_the_truth(
    detections: list[tuple[int, tuple[float, ...]]],
    truth: list[tuple[int, tuple[float, ...]]],
    right: int,
    wrong: int,
    missed: int,
) -> None:
    result = tally([(_detections(*detections), _image(*truth))])
    assert len(result.mask_ious) == 0
    assert (len(result.scores), result.wrong, result.missed) == (right, wrong, missed)
    assert result.precision == (right / (right + wrong) if right + wrong else 1)
    assert result.recall == (right / (right + missed) if right + missed else 1)
