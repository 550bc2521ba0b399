"""Which detection belongs to which track: IoU and the best assignment."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.intp]


def iou_matrix(
    boxes_xyxy: NDArray[Any], others_xyxy: NDArray[Any], margin_xy: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Intersection over union (n, m) of every box (n, 4) with every other (m, 4); 0 for two empty boxes.

    With `margin_xy` (n, 2) both boxes of a pair are larger by the row's margin on each side.
    """
    margins = np.zeros((len(boxes_xyxy), 2)) if margin_xy is None else margin_xy
    shape = len(boxes_xyxy), len(others_xyxy)
    shared, area, other_area = np.ones(shape), np.ones((shape[0], 1)), np.ones(shape)
    for axis in range(2):
        low, high = boxes_xyxy[:, axis, None].astype(np.float64), boxes_xyxy[:, axis + 2, None]  # (n, 1)
        other_low, other_high = others_xyxy[:, axis].astype(np.float64), others_xyxy[:, axis + 2]  # (m,)
        growth = 2 * margins[:, axis, None]
        side = np.minimum(high, other_high) - np.maximum(low, other_low) + growth  # (n, m)
        shared *= np.maximum(side, 0, out=side)
        area *= high - low + growth
        other_area *= other_high - other_low + growth
    union = area + other_area - shared
    iou: NDArray[np.float64] = np.divide(shared, union, out=np.zeros(shape), where=union > 0)
    return iou


def best_pairs(
    similarity: NDArray[np.float64], rows: Indices, columns: Indices, threshold: float
) -> tuple[Indices, Indices]:
    """Rows and columns of `similarity`, one to one, with the largest sum of similarities.

    Only the given `rows` and `columns` take part, and only pairs of at least `threshold`, which is above 0.
    """
    from scipy.optimize import linear_sum_assignment  # optional, see ByteTracker

    gated = similarity[np.ix_(rows, columns)]
    gated[gated < threshold] = 0
    possible = gated > 0
    rows_taking_part, columns_taking_part = possible.any(axis=1), possible.any(axis=0)
    rows, columns = rows[rows_taking_part], columns[columns_taking_part]
    gated = gated[np.ix_(rows_taking_part, columns_taking_part)]
    chosen_rows, chosen_columns = linear_sum_assignment(gated, maximize=True)
    real = gated[chosen_rows, chosen_columns] > 0
    return rows[chosen_rows[real]], columns[chosen_columns[real]]
