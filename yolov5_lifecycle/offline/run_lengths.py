"""Masks in COCO's run-length encoding (RLE), in the form that `pycocotools.mask.decode` reads."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.masks import Window

_MAX_CHARACTERS = 7
"""Characters per number, of 5 bits each: enough for the difference of any two runs of up to 2**32 pixels."""


def coco_rle(window: Window, inside: NDArray[np.bool_], size_hw: tuple[int, int]) -> dict[str, object]:
    """A mask of a whole image of `size_hw`, for JSON: `size` is height and width, `counts` the runs.

    `inside` says which pixels of `window` belong to the object; outside of it none does.
    """
    return {"size": list(size_hw), "counts": counts_string(run_lengths(window, inside, size_hw))}


def run_lengths(window: Window, inside: NDArray[np.bool_], size_hw: tuple[int, int]) -> NDArray[np.int64]:
    """Numbers of pixels outside, inside, outside ... of the mask, one column of the image after the other.

    The first is 0 if the first pixel is inside, all others are positive.
    """
    height, width = size_hw
    changes = _changes_down_columns(inside)
    # A run that ends at the bottom of a column continues in one that begins at the top of the next.
    places, times = np.unique(
        (window.columns.start + changes.columns) * height + window.rows.start + changes.rows,
        return_counts=True,
    )
    ends = np.append(places[(times == 1) & (places < height * width)], height * width)
    return np.diff(ends, prepend=0).astype(np.int64, copy=False)


class _Changes(NamedTuple):
    """Places of pixels that differ from the one above; above the first and below the last row all is 0."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


def _changes_down_columns(inside: NDArray[np.bool_]) -> _Changes:
    height, width = inside.shape
    between = np.zeros((height + 2, width), np.bool_)
    between[1:-1] = inside
    return _Changes(*divmod(np.flatnonzero(between[1:] != between[:-1]), width))


def counts_string(counts: NDArray[np.int64]) -> str:
    """Run lengths as text: from the fourth on, the difference from the last but one.

    A number is written as in signed LEB128, but with 5 bits a character, lowest first: bit 5 says that the
    number continues, and 48 is added to make it ASCII.
    """
    numbers = counts.copy()
    numbers[3:] -= counts[1:-2]
    rest = numbers[:, None] >> (5 * np.arange(_MAX_CHARACTERS))  # (n, 7)
    bits = rest & 0x1F
    sign = np.where(bits & 0x10, -1, 0)
    goes_on = rest >> 5 != sign
    is_written = np.column_stack((np.ones(len(counts), np.bool_), goes_on[:, :-1]))
    characters = bits + 0x20 * goes_on + 48
    text: bytes = characters[is_written].astype(np.uint8).tobytes()
    return text.decode("ascii")
