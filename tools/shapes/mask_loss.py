"""The loss of masks, from its published description.

Bolya et al., "YOLACT: Real-time Instance Segmentation", https://arxiv.org/abs/1904.02689, section 3: a mask
is the logistic function of coefficients @ prototypes; its loss is the binary cross-entropy to the ground
truth, cropped to the box and divided by the area of the box.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from tools.shapes.images import MASK_CELL_PX
from tools.shapes.loss import match
from yolov5_lifecycle.models.architecture import Architecture

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
