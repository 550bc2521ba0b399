"""How the embedded model learns masks: their ground truth, their loss, and how they are compared."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY
from torch import Tensor

from tools.shapes.evaluate import tally
from tools.shapes.images import MASK_CELL_PX, Batches, covered_shares
from tools.shapes.labelled_image import LabelledImage
from tools.shapes.learning import as_input
from tools.shapes.mask_loss import COVERED_GAIN, mask_loss
from tools.shapes.train import ARCHITECTURE
from tools.shapes.train_masks import MaskBranch, joined, segmenting
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.sources.scene import Truth

pytestmark = pytest.mark.long

SEGMENTING = segmenting(ARCHITECTURE)


@pytest.fixture(scope="module")
def model() -> Model:
    return load_weights(REPOSITORY / "weights" / "shapes.safetensors").model


@pytest.mark.parametrize("index", range(6))
def test_the_masks_of_a_batch_lie_in_the_boxes_of_its_targets_and_fill_them(index: int) -> None:
    batch = Batches(2, 9)[index]
    height, width = (side // MASK_CELL_PX for side in batch.pixels.shape[2:])
    assert batch.masks.shape == (len(batch.targets), height, width)
    assert batch.masks.dtype == torch.float32
    for (_, _, x, y, w, h), mask in zip(batch.targets.tolist(), batch.masks, strict=True):
        rows, columns = mask.nonzero().T
        (left, right), (top, bottom) = columns.aminmax(), rows.aminmax()
        filled = torch.stack((left, top, right + 1, bottom + 1)) * MASK_CELL_PX
        box = torch.tensor((x - w / 2, y - h / 2, x + w / 2, y + h / 2))
        torch.testing.assert_close(filled.float(), box, atol=MASK_CELL_PX + 1.5, rtol=0)
        share = mask.sum() * MASK_CELL_PX**2 / (w * h)
        assert 0.25 < share < 1.01


def test_the_share_of_a_cell_is_that_of_its_pixels() -> None:
    labels = np.zeros((8, 12), np.uint16)
    labels[1:3, 4:8] = 1
    labels[2:8, 7:12] = 2
    shares = covered_shares(labels, 3)
    assert shares.dtype == np.float32
    expected = [[[0, 7, 0], [0, 0, 0]], [[0, 2, 8], [0, 4, 16]], np.zeros((2, 3))]
    np.testing.assert_array_equal(shares * MASK_CELL_PX**2, expected)


def _coefficients(batch: int = 1) -> list[Tensor]:
    torch.manual_seed(0)
    return [torch.randn(batch, 3, side, side, SEGMENTING.mask_coefficients) for side in (8, 4, 2)]


def test_the_loss_of_masks_is_that_of_a_slow_reference() -> None:
    coefficients = _coefficients(batch=2)
    prototypes = torch.randn(2, SEGMENTING.mask_coefficients, 16, 16)
    # One cell and anchor each: in a corner of the image, and of a size that fits one anchor only.
    targets = torch.tensor([[0, 1, 1.0, 1.0, 9.0, 9.0], [1, 0, 63.0, 63.0, 9.0, 10.0]])
    masks = torch.rand(2, 16, 16)
    expected = 0.0
    for (image, _, x, y, w, h), mask, cell in zip(targets.tolist(), masks, (0, 7), strict=True):
        total = 0.0
        for row, column in np.ndindex(16, 16):
            is_near = abs(column + 0.5 - x / 4) < w / 8 + 1 and abs(row + 0.5 - y / 4) < h / 8 + 1
            logit = coefficients[0][int(image), 0, cell, cell] @ prototypes[int(image), :, row, column]
            found, wanted = 1 / (1 + math.exp(-float(logit))), float(mask[row, column])
            total -= is_near * COVERED_GAIN * wanted * math.log(found)
            total -= is_near * (1 - wanted) * math.log(1 - found)
        expected += total / (w / 4 * h / 4) / 2
    loss = mask_loss(coefficients, prototypes, targets, masks, SEGMENTING)
    assert loss.item() == pytest.approx(expected, rel=1e-4)


def test_without_targets_no_mask_is_to_be_learnt() -> None:
    prototypes = torch.randn(1, SEGMENTING.mask_coefficients, 16, 16)
    loss = mask_loss(_coefficients(), prototypes, torch.empty(0, 6), torch.empty(0, 16, 16), SEGMENTING)
    assert loss.item() == 0


def test_learning_lowers_the_loss_of_masks(model: Model) -> None:
    torch.manual_seed(0)
    network = model.network().eval()
    branch = MaskBranch(SEGMENTING, network.head)
    batch = Batches(4, 9)[1]
    with torch.no_grad():
        features = network.features(as_input(batch.pixels))
    optimizer = torch.optim.AdamW(branch.parameters(), lr=3e-3)
    losses = []
    for _ in range(8):
        coefficients, prototypes = branch(features)
        loss = mask_loss(coefficients, prototypes, batch.targets, batch.masks, SEGMENTING)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


def test_the_model_that_segments_computes_what_both_parts_do(model: Model) -> None:
    torch.manual_seed(0)
    network = model.network().eval()
    branch = MaskBranch(SEGMENTING, network.head).eval()
    branch.load_state_dict({key: _in_fp16(tensor) for key, tensor in branch.state_dict().items()})
    segmenter = joined(model, SEGMENTING, branch).network().eval()
    pixels = as_input(Batches(4, 9)[1].pixels[:2])
    with torch.no_grad():
        coefficients, prototypes = branch(network.features(pixels))
        features = segmenter.features(pixels)
        together, detecting = segmenter.head(features), network.heads(pixels)
        torch.testing.assert_close(segmenter.head.get_submodule("proto")(features[0]), prototypes)
    for level, detected, found in zip(together, detecting, coefficients, strict=True):
        torch.testing.assert_close(level, torch.cat((detected, found), dim=-1))


def _in_fp16(tensor: Tensor) -> Tensor:
    return tensor.half().float() if tensor.is_floating_point() else tensor


def _found(mask: NDArray[np.bool_], box_xyxy: tuple[float, ...]) -> Detections:
    """One detection, with `mask` as its only prototype."""
    prototypes = np.where(mask, np.float32(9), np.float32(-9))[None]
    return Detections(
        np.array([box_xyxy], np.float32),
        np.array([0.9], np.float32),
        np.array([0], np.int64),
        masks=Masks(prototypes, np.ones((1, 1), np.float32), mask.shape),
    )


@pytest.mark.parametrize(
    ("columns", "iou"),
    [
        pytest.param(slice(10, 20), 1.0, id="all of it"),
        pytest.param(slice(10, 15), 0.5, id="its left half"),
        pytest.param(slice(5, 20), 1.0, id="more than it, outside the box"),
        pytest.param(slice(20, 30), 0.0, id="beside it"),
    ],
)
def test_masks_are_compared_with_the_pixels_of_their_shapes(columns: slice, iou: float) -> None:
    mask = np.zeros((40, 40), np.bool_)
    mask[10:30, columns] = True
    labels = np.zeros((40, 40), np.uint16)
    labels[10:30, 10:20] = 2
    labels[0:5, 0:5] = 1
    box = (10.0, 10.0, 20.0, 30.0)
    truth = Truth(np.array([(0, 0, 5, 5), box], np.float32), np.array([0, 0], np.int64))
    image = LabelledImage(np.zeros((40, 40, 3), np.uint8), truth, labels)
    assert tally([(_found(mask, box), image)]).mask_ious.tolist() == [pytest.approx(iou)]
