"""Writes a palette PNG, a quarter of the size of a full-colour one; OpenCV cannot write palettes."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

_SAMPLES = 20_000
_ROWS = 20
"""Rows of pixels matched with the palette at once."""
_SEED = 1
_DITHERING = 3
"""How much lighter or darker, of 255."""


def write_palette_image(path: Path, pixels: NDArray[np.uint8], *, colours: int = 256) -> None:
    """Write BGR `pixels` (H, W, 3) with at most `colours` colours, up to 256."""
    dithered = _dithered(pixels)
    palette = _palette(dithered, colours)
    rows = [_nearest(part, palette) for part in np.array_split(dithered, len(pixels) // _ROWS + 1)]
    lines = b"".join(b"\0" + row.tobytes() for row in np.concatenate(rows))
    height, width = pixels.shape[:2]
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0))
        + _chunk(b"PLTE", palette[:, ::-1].tobytes())
        + _chunk(b"IDAT", zlib.compress(lines, 9))
        + _chunk(b"IEND", b"")
    )


def _dithered(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Alternately lighter and darker, so that gradients have no steps; areas of one colour stay."""
    signs = 1 - 2 * (np.indices(pixels.shape[:2]).sum(axis=0) % 2)
    changed = np.clip(pixels.astype(np.int32) + _DITHERING * signs[..., None], 0, 255)
    is_flat = np.all(cv2.blur(pixels, (5, 5)) == pixels, axis=2, keepdims=True)
    return np.where(is_flat, pixels, changed).astype(np.uint8)


def _palette(pixels: NDArray[np.uint8], colours: int) -> NDArray[np.uint8]:
    """The colours (n, 3) that most of the image is made of: most frequent ones, and means of the rest."""
    flat = pixels.reshape(-1, 3)
    found, counts = np.unique(flat, axis=0, return_counts=True)
    frequent = found[np.argsort(counts)[: -colours // 4 - 1 : -1]]
    sample = flat[np.random.default_rng(_SEED).choice(len(flat), _SAMPLES)].astype(np.float32)
    cv2.setRNGSeed(_SEED)
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 1.0)
    means = cv2.kmeans(sample, colours - len(frequent), None, until, 1, cv2.KMEANS_PP_CENTERS)[2]
    return np.concatenate([frequent, np.rint(means).astype(np.uint8)])


def _nearest(pixels: NDArray[np.uint8], palette: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Index (H, W) of the nearest colour."""
    distances = pixels[:, :, None].astype(np.int32) - palette.astype(np.int32)
    return np.asarray((distances**2).sum(axis=3).argmin(axis=2), np.uint8)


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
