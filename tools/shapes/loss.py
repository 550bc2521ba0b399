"""YOLOv5's training losses, of boxes and of masks, from their published descriptions.

Jocher, "YOLOv5 architecture description", https://docs.ultralytics.com/yolov5/tutorials/architecture_description/
(sections 4.1 losses, 4.2 balance, 4.4 build targets); CIoU: Zheng et al., https://arxiv.org/abs/1911.08287.
Bolya et al., "YOLACT: Real-time Instance Segmentation", https://arxiv.org/abs/1904.02689, section 3: a mask
is the logistic function of coefficients @ prototypes; its loss is the binary cross-entropy to the ground
truth, cropped to the box and divided by the area of the box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from tools.shapes.images import MASK_CELL_PX
from yolov5_lifecycle.models.architecture import Architecture

# Maximum ratio of a box side to its anchor's. YOLOv5 uses 4, but with anchors as dense as ours all three
# levels would then be assigned to a shape.
_LARGEST_RATIO = 2.5
_LEVEL_BALANCE = (4.0, 1.0, 0.4)  # objectness of the fine levels is harder to learn
_BOX_GAIN, _OBJECTNESS_GAIN, _CLASS_GAIN = 0.05, 0.4, 0.1


@dataclass(frozen=True)
class Matches:
    """Cells of one level assigned to a target: indices (m,) into the logits, and their target values."""

    images: Tensor
    anchors: Tensor
    rows: Tensor
    columns: Tensor
    anchors_wh: Tensor  # (m, 2) grid cells
    boxes: Tensor  # (m, 4) cx, cy, w, h in grid cells, relative to the cell's corner
    class_ids: Tensor
    targets: Tensor  # rows of the targets


def detection_loss(logits: list[Tensor], targets: Tensor, architecture: Architecture) -> Tensor:
    """Loss (scalar) of the logits of all levels, (B, anchors, ny, nx, 5 + C), against `targets`.

    `targets`: (n, 6): image index, class, cx, cy, w, h in network pixels.
    """
    total = logits[0].new_zeros(())
    levels = zip(logits, architecture.strides, architecture.anchors_px, _LEVEL_BALANCE, strict=True)
    for level, stride, anchors_px, balance in levels:
        anchors_wh = level.new_tensor(anchors_px) / stride
        matches = match(targets, anchors_wh, stride=stride, grid_hw=(level.shape[2], level.shape[3]))
        objectness = torch.zeros_like(level[..., 4])
        if len(matches.images):
            where = (matches.images, matches.anchors, matches.rows, matches.columns)
            answers = level[where]
            overlap = ciou(_decoded(answers, matches.anchors_wh), matches.boxes)
            wanted = functional.one_hot(matches.class_ids, architecture.classes).to(level.dtype)
            total = total + _BOX_GAIN * (1 - overlap).mean()
            total = total + _CLASS_GAIN * functional.binary_cross_entropy_with_logits(answers[:, 5:], wanted)
            objectness[where] = overlap.detach().clamp(min=0).to(level.dtype)
        missed = functional.binary_cross_entropy_with_logits(level[..., 4], objectness)
        total = total + _OBJECTNESS_GAIN * balance * missed
    return total


def match(targets: Tensor, anchors_wh: Tensor, *, stride: int, grid_hw: tuple[int, int]) -> Matches:
    """Assign cells and anchors of one level to targets, (n, 6) as for `detection_loss`.

    Selects every anchor, `anchors_wh` (a, 2) in grid cells, with sides within _LARGEST_RATIO of the target's;
    the cell with the centre and its two nearest neighbours, as xy = 2 sigma - 0.5 reaches half a cell beyond.
    """
    boxes = targets[:, 2:] / stride
    ratio = boxes[:, None, 2:] / anchors_wh[None]  # (n, a, 2)
    target, anchor = (torch.maximum(ratio, 1 / ratio).amax(dim=2) < _LARGEST_RATIO).nonzero(as_tuple=True)
    centre = boxes[target, :2]
    side = torch.where(centre % 1 < 0.5, -1, 1)  # towards the nearer neighbour in x and in y
    steps = torch.zeros(3, len(target), 2, dtype=torch.long, device=targets.device)
    steps[1, :, 0], steps[2, :, 1] = side[:, 0], side[:, 1]
    cells = centre.floor().long() + steps  # (3, m, 2)
    size_xy = cells.new_tensor((grid_hw[1], grid_hw[0]))
    step, hit = ((cells >= 0) & (cells < size_xy)).all(dim=2).nonzero(as_tuple=True)
    cells, target, anchor = cells[step, hit], target[hit], anchor[hit]
    return Matches(
        images=targets[target, 0].long(),
        anchors=anchor,
        rows=cells[:, 1],
        columns=cells[:, 0],
        anchors_wh=anchors_wh[anchor],
        boxes=torch.cat((boxes[target, :2] - cells, boxes[target, 2:]), dim=1),
        class_ids=targets[target, 1].long(),
        targets=target,
    )


def ciou(boxes: Tensor, others: Tensor) -> Tensor:
    """Complete IoU (m,) of boxes (m, 4) cx, cy, w, h: IoU minus centre distance and aspect penalties."""
    xy, wh = boxes.split(2, dim=1)
    other_xy, other_wh = others.split(2, dim=1)
    lower, other_lower = xy - wh / 2, other_xy - other_wh / 2
    upper, other_upper = xy + wh / 2, other_xy + other_wh / 2
    shared = (torch.minimum(upper, other_upper) - torch.maximum(lower, other_lower)).clamp(min=0).prod(dim=1)
    iou = shared / (wh.prod(dim=1) + other_wh.prod(dim=1) - shared + 1e-7)
    hull = torch.maximum(upper, other_upper) - torch.minimum(lower, other_lower)
    distance = (xy - other_xy).pow(2).sum(dim=1) / (hull.pow(2).sum(dim=1) + 1e-7)
    angle = torch.atan(wh[:, 0] / (wh[:, 1] + 1e-7)) - torch.atan(other_wh[:, 0] / other_wh[:, 1])
    aspect = 4 / math.pi**2 * angle.pow(2)
    weight = (aspect / (1 - iou + aspect + 1e-7)).detach()
    complete: Tensor = iou - distance - weight * aspect
    return complete


def _decoded(answers: Tensor, anchors_wh: Tensor) -> Tensor:
    """Logits (m, 5 + C) -> boxes (m, 4) cx, cy, w, h in grid cells relative to the cell."""
    sigma = answers[:, :4].sigmoid()
    return torch.cat((2 * sigma[:, :2] - 0.5, (2 * sigma[:, 2:]) ** 2 * anchors_wh), dim=1)


COVERED_GAIN = 1.5
"""Weight of covered cells. Where the network is unsure, as at the points of a star, it predicts the expected
share, and a threshold of one half is too high: of 0.3 to 0.5 in steps of 0.05, masks were best above 0.35 to
0.4. To keep the threshold at one half, covered cells weigh more: a share of 0.4 becomes 0.5."""


def mask_loss(
    coefficients: list[Tensor],
    prototypes: Tensor,
    targets: Tensor,
    masks: Tensor,
    architecture: Architecture,
) -> Tensor:
    """Mean loss (scalar) of the masks of all cells and anchors that `match` assigns to a target.

    `coefficients` of each level (B, anchors, ny, nx, M), `prototypes` (B, M, h, w), `targets` (n, 6) as for
    `detection_loss` and their `masks` (n, h, w), the share of each cell that is covered: resized to the
    image, shares give finer outlines than 0 and 1.
    """
    images, rows, assigned = _assigned(coefficients, targets, architecture)
    weights = _crops(targets[:, 2:] / MASK_CELL_PX, masks)
    total = prototypes.new_zeros(())
    for image in images.unique().tolist():
        of_image = images == image
        total = total + functional.binary_cross_entropy_with_logits(
            torch.einsum("nm,mhw->nhw", assigned[of_image], prototypes[image]),
            masks[rows[of_image]],
            weight=weights[rows[of_image]],
            pos_weight=prototypes.new_tensor(COVERED_GAIN),
            reduction="sum",
        )
    return total / max(len(images), 1)


def _assigned(
    coefficients: list[Tensor], targets: Tensor, architecture: Architecture
) -> tuple[Tensor, Tensor, Tensor]:
    """Image (m,), row of the target (m,) and coefficients (m, M) of each assigned cell of all levels."""
    images, rows, assigned = [], [], []
    levels = zip(coefficients, architecture.strides, architecture.anchors_px, strict=True)
    for level, stride, anchors_px in levels:
        anchors_wh = level.new_tensor(anchors_px) / stride
        matches = match(targets, anchors_wh, stride=stride, grid_hw=(level.shape[2], level.shape[3]))
        images.append(matches.images)
        rows.append(matches.targets)
        assigned.append(level[matches.images, matches.anchors, matches.rows, matches.columns])
    return torch.cat(images), torch.cat(rows), torch.cat(assigned)


def _crops(boxes_cxcywh: Tensor, masks: Tensor) -> Tensor:
    """Weights (n, h, w) of the cells: 1 / area in each box (n, 4) in cells, 0 outside.

    A box reaches one cell farther on each side, because these are read when a mask is resized.
    """
    height, width = masks.shape[1:]
    xs = torch.arange(width, device=masks.device) + 0.5
    ys = torch.arange(height, device=masks.device)[:, None] + 0.5
    cx, cy, w, h = boxes_cxcywh[:, :, None, None].unbind(dim=1)
    is_inside = ((xs - cx).abs() < w / 2 + 1) & ((ys - cy).abs() < h / 2 + 1)
    return is_inside / (w * h)
