"""A model that was exported to ONNX, which is run as it is."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class Export:
    """A checked ONNX file, and what its inputs and outputs mean.

    The graph reads images (batch, `channels`, h, w) in [0, 1], RGB or grey, of float32 or, if it `is_half`,
    float16. Its boxes are (batch, N, 5 + C + M) with objectness, as those of YOLOv5, or without it
    (batch, 4 + C + M, N), as those of YOLOv5u and later: cx, cy, w, h in pixels, scores in [0, 1],
    coefficients of masks. Its prototypes are (batch, M, h, w).
    """

    graph: bytes
    class_names: tuple[str, ...]
    channels: int
    stride: int
    """Height and width of images are multiples of it."""
    is_half: bool
    has_objectness: bool
    mask_coefficients: int
    """M, 0 for a model that does not segment."""
    boxes: int
    """Which of the outputs they are."""
    prototypes: int | None
    size_hw: tuple[int, int] | None
    """The only size of its images; None for any."""
    batch: int | None
    """The only number of images in a run; None for any."""

    @property
    def precision(self) -> str:
        return "fp16" if self.is_half else "fp32"
