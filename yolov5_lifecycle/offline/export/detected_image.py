"""An image of a source and its detections, as every output gets them, and what an output is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.masks import Window
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import StoredImage

_RLE_CHARACTERS = 7
"""Per number, of 5 bits each: enough for the difference of any two runs of up to 2**32 pixels."""


class NamedImage(StoredImage, Protocol):
    """A stored image that can be told from the others of its source."""

    @property
    def identity(self) -> Mapping[str, str | int]:
        """What tells it from the others: `file`, `frame`, or `stamp_ns` and `frame`. Raises ImageError."""

    @property
    def stem(self) -> str:
        """Name of files about this image, without a suffix; raises ImageError."""


@dataclass(frozen=True, eq=False)
class DetectedImage:
    """A named image, its pixels and what was detected in it; boxes in pixels of the image."""

    named: NamedImage
    image: ColourImage
    detections: Detections

    def mask(self, row: int) -> tuple[dict[str, object], int] | None:
        """COCO's RLE of the mask of detection `row` and its number of pixels; None without masks."""
        masks = self.detections.masks
        if masks is None:
            return None
        window, inside = masks.inside_box(row, self.detections.boxes_xyxy[row])
        return coco_rle(window, inside, masks.size_hw), int(inside.sum())

    @property
    def inside_xyxy(self) -> NDArray[np.float32]:
        """The boxes, cut at the edges of the image."""
        height, width = self.image.size_hw
        limits = np.array((width, height, width, height), np.float32)
        cut: NDArray[np.float32] = np.clip(self.detections.boxes_xyxy, 0, limits)
        return cut


class Sink:
    """Where detected images go, one after the other."""

    def add(self, found: DetectedImage) -> None:
        """Write an image; raises OutputError, OSError and ImageError."""
        raise NotImplementedError

    def finish(self) -> None:
        """Complete the output after the last image; raises OutputError and OSError."""
        self.close()

    def close(self) -> None:
        """Release what is open, also if called twice; output that is not finished may be damaged."""


def coco_rle(window: Window, inside: NDArray[np.bool_], size_hw: tuple[int, int]) -> dict[str, object]:
    """A mask of a whole image in COCO's run-length encoding, as `pycocotools.mask.encode` writes it.

    `inside` (h, w) says which pixels of `window` belong to the object; outside of it none does. pycocotools
    would need the whole image for each object, and is optional.
    """
    height, width = size_hw
    between = np.zeros((inside.shape[0] + 2, inside.shape[1]), np.bool_)
    between[1:-1] = inside
    rows, columns = np.nonzero(between[1:] != between[:-1])  # pixels that differ from the one above
    # A run that ends at the bottom of a column continues in one that begins at the top of the next.
    places, times = np.unique(
        (window.columns.start + columns) * height + window.rows.start + rows, return_counts=True
    )
    ends = np.append(places[(times == 1) & (places < height * width)], height * width)
    return {"size": [height, width], "counts": _rle_text(np.diff(ends, prepend=0).astype(np.int64))}


def _rle_text(runs: NDArray[np.int64]) -> str:
    """Lengths of runs as text: from the fourth on, the difference from the last but one.

    A number is written as in signed LEB128, but with 5 bits a character, lowest first: bit 5 says that the
    number continues, and 48 is added to make it ASCII.
    """
    numbers = runs.copy()
    numbers[3:] -= runs[1:-2]
    rest = numbers[:, None] >> (5 * np.arange(_RLE_CHARACTERS))  # (n, 7)
    bits = rest & 0x1F
    goes_on = rest >> 5 != np.where(bits & 0x10, -1, 0)
    is_written = np.column_stack((np.ones(len(runs), np.bool_), goes_on[:, :-1]))
    text: bytes = (bits + 0x20 * goes_on + 48)[is_written].astype(np.uint8).tobytes()
    return text.decode("ascii")
