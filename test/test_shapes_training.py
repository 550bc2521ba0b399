"""The training of the embedded models: their images, their losses and how results are counted."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY
from torch import Tensor

from tools.shapes.evaluate import tally
from tools.shapes.images import MASK_CELL_PX, Batches
from tools.shapes.learning import as_input
from tools.shapes.loss import detection_loss, mask_loss
from tools.shapes.random_shapes import LabelledImage
from tools.shapes.train import ARCHITECTURE
from tools.shapes.train_masks import MaskBranch, joined, segmenting
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.sources.scene import Truth

pytestmark = pytest.mark.long

SEGMENTING = segmenting(ARCHITECTURE)
BOX, SHIFTED_BOX, FAR_BOX = (0, 0, 10, 10), (1, 0, 11, 10), (50, 50, 60, 60)


@pytest.fixture(scope="module")
def model() -> Model:
    return load_weights(REPOSITORY / "weights" / "shapes.safetensors").model


def _truth(*rows: tuple[int, tuple[float, ...]]) -> Truth:
    boxes = np.array([box for _, box in rows], np.float32).reshape(-1, 4)
    return Truth(boxes, np.array([class_id for class_id, _ in rows], np.int64))


def _image(*rows: tuple[int, tuple[float, ...]]) -> LabelledImage:
    return LabelledImage(np.zeros((64, 64, 3), np.uint8), _truth(*rows), np.zeros((64, 64), np.uint16))


def _detections(*rows: tuple[int, tuple[float, ...]]) -> Detections:
    truth = _truth(*rows)
    return Detections(truth.boxes_xyxy, np.linspace(0.9, 0.5, len(rows), dtype=np.float32), truth.class_ids)


@pytest.mark.parametrize("index", range(3))
def test_the_targets_and_masks_of_a_batch_lie_in_its_images_and_fill_their_boxes(index: int) -> None:
    batch, same, other = Batches(2, 9)[index], Batches(2, 9)[index], Batches(2, 9)[index + 1]
    assert torch.equal(batch.pixels, same.pixels)
    assert torch.equal(batch.targets, same.targets)
    assert not torch.equal(batch.targets, other.targets)
    count, _, height, width = batch.pixels.shape
    assert batch.pixels.dtype == torch.uint8
    assert height % 32 == width % 32 == 0
    assert batch.targets[:, 0].max() < count
    assert batch.masks.shape == (len(batch.targets), height // MASK_CELL_PX, width // MASK_CELL_PX)
    for (_, _, x, y, w, h), mask in zip(batch.targets.tolist(), batch.masks, strict=True):
        box = torch.tensor((x - w / 2, y - h / 2, x + w / 2, y + h / 2))
        assert ((box >= -1e-3) & (box <= torch.tensor((width, height) * 2) + 1e-3)).all()
        rows, columns = mask.nonzero().T
        (left, right), (top, bottom) = columns.aminmax(), rows.aminmax()
        filled = torch.stack((left, top, right + 1, bottom + 1)) * MASK_CELL_PX
        torch.testing.assert_close(filled.float(), box, atol=MASK_CELL_PX + 1.5, rtol=0)
        assert 0.25 < mask.sum() * MASK_CELL_PX**2 / (w * h) < 1.01


def test_learning_lowers_both_losses(model: Model) -> None:
    torch.manual_seed(0)
    batch = Batches(4, 9)[1]
    network, taught = Network(ARCHITECTURE), model.network().eval()
    branch = MaskBranch(SEGMENTING, taught.head)
    with torch.no_grad():
        features = taught.features(as_input(batch.pixels))
    targets = batch.targets[batch.targets[:, 0] < 2]
    optimizer = torch.optim.AdamW([*network.parameters(), *branch.parameters()], lr=3e-3)
    losses = []
    for _ in range(12):
        of_boxes = detection_loss(network.heads(as_input(batch.pixels[:2])), targets, ARCHITECTURE)
        coefficients, prototypes = branch(features)
        of_masks = mask_loss(coefficients, prototypes, batch.targets, batch.masks, SEGMENTING)
        optimizer.zero_grad()
        (of_boxes + of_masks).backward()
        optimizer.step()
        losses.append((of_boxes.item(), of_masks.item()))
    assert losses[-1][0] < 0.8 * losses[0][0]
    assert losses[-1][1] < 0.5 * losses[0][1]


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
