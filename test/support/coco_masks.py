"""Reads masks in COCO's run-length encoding, one number and one pixel at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray


def mask_of_rle(rle: Any) -> NDArray[np.bool_]:
    """The mask of a whole image from its `size` and the text of its `counts`."""
    height, width = rle["size"]
    counts = counts_of_text(rle["counts"])
    pixels = [number % 2 == 1 for number, count in enumerate(counts) for _ in range(count)]
    assert len(pixels) == height * width
    mask = np.zeros((height, width), np.bool_)
    for place, is_inside in enumerate(pixels):
        mask[place % height, place // height] = is_inside
    return mask


def counts_of_text(text: str) -> list[int]:
    """Lengths of the runs; only the first may be 0."""
    counts: list[int] = []
    for number in _signed_numbers(text):
        counts.append(number + (counts[-2] if len(counts) > 2 else 0))
    assert counts[0] >= 0
    assert min(counts[1:], default=1) > 0
    return counts


def _signed_numbers(text: str) -> Iterator[int]:
    number, bits = 0, 0
    for character in text:
        value = ord(character) - 48
        assert 0 <= value < 64
        number += (value & 31) << bits
        bits += 5
        if not value & 32:
            yield number - (1 << bits if value & 16 else 0)
            number, bits = 0, 0
    assert bits == 0
