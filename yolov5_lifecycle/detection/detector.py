"""Detector: letterbox, inference and NMS for one image."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.letterbox import PADDING_VALUE, Letterbox
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.detection.nms import Counts, Selection, select
from yolov5_lifecycle.images.image import ChannelOrder, ColourImage, ImageError
from yolov5_lifecycle.models.architecture import image_size_problem
from yolov5_lifecycle.runtimes.runtime import InferenceError, Predictions, Runtime

if TYPE_CHECKING:  # it would import torch
    from yolov5_lifecycle.models.cost import Cost

USUAL_SOURCE_HW = (480, 640)


class Detector:
    """Detects objects in images. Owns `runtime`; stateless between images.

    Detects for one thread at a time, others wait: two would overwrite each other's features. For threads that
    detect at the same time there are `streams`.

    `class_names` by class id. `image_size`: longer side of the network input in pixels, a multiple of
    `stride`, the largest stride of the model; else ValueError. `choice`: why this runtime was selected.
    `mask_coefficients`: their number per prediction, 0 if the model does not segment. `cost`: of an image of
    `image_size` x `image_size`, None if it is unknown. `fixed_hw`: the only size of the network input, if the
    model takes no other.
    `selection`: the thresholds and classes of a call; may be replaced.
    """

    def __init__(
        self,
        runtime: Runtime,
        *,
        class_names: Sequence[str],
        image_size: int,
        stride: int,
        choice: str = "as set",
        mask_coefficients: int = 0,
        cost: Cost | None = None,
        fixed_hw: tuple[int, int] | None = None,
    ) -> None:
        check_image_size(image_size, stride)
        self.runtime = runtime
        self.choice = choice
        self.class_names = tuple(class_names)
        self.image_size = image_size
        self.stride = stride
        self.mask_coefficients = mask_coefficients
        self.cost = cost
        self.fixed_hw = fixed_hw
        self.selection = Selection()
        self.in_use = threading.RLock()

    def __call__(self, pixels: NDArray[np.uint8], *, channel_order: ChannelOrder = "bgr") -> Detections:
        """Detections in an image (H, W, 3) of dtype uint8, as cv2.imread returns it; see `detect`.

        Raises ImageError for anything else, such as None from cv2.imread.
        """
        if channel_order not in ("bgr", "rgb"):
            raise ImageError(f"Expected 'bgr' or 'rgb' as channel_order, found {channel_order!r}.")
        return self.detect(ColourImage(pixels, channel_order), self.selection)

    def detect(self, image: ColourImage, selection: Selection) -> Detections:
        """Detections in pixels of `image`, clipped to it; boxes entirely in the padding are dropped.

        Raises InferenceError when the network fails or its predictions are invalid.
        """
        letterbox = self._letterbox(image.size_hw)
        pixels, channel_order = image.as_sent
        frame = letterbox.apply(pixels)
        with self.in_use:
            raw = self.runtime(frame, channel_order, selection.min_objectness)
            return self._detections(raw, letterbox, selection)

    def network_hw(self, size_hw: tuple[int, int]) -> tuple[int, int]:
        """Height and width of the network input for images of `size_hw`, in pixels."""
        return self._letterbox(size_hw).network_hw

    @property
    def segments(self) -> bool:
        """Whether the model computes masks."""
        return self.mask_coefficients > 0

    def _letterbox(self, size_hw: tuple[int, int]) -> Letterbox:
        if self.fixed_hw is not None:
            return Letterbox.into(size_hw, self.fixed_hw)
        return Letterbox.fit(size_hw, image_size=self.image_size, stride=self.stride)

    def _detections(self, predictions: Predictions, letterbox: Letterbox, selection: Selection) -> Detections:
        raw = predictions.rows
        self._check(raw)
        found = select(raw[:, : 5 + len(self.class_names)], selection, _counts(selection, letterbox))
        boxes_xyxy = letterbox.undo(found.boxes_xyxy)
        visible = (boxes_xyxy[:, :2] < boxes_xyxy[:, 2:]).all(axis=1)
        masks = None
        if selection.with_masks and predictions.compute_prototypes is not None:
            coefficients = raw[found.rows[visible], 5 + len(self.class_names) :]
            masks = _masks(predictions.compute_prototypes, coefficients, letterbox.source_hw)
        compute_embedding = predictions.compute_embedding if selection.with_embedding else None
        return Detections(
            boxes_xyxy[visible],
            found.scores[visible],
            found.class_ids[visible],
            found.best_missed,
            masks=masks,
            best_filtered=found.best_filtered,
            embedding=compute_embedding() if compute_embedding else None,
        )

    def warm_up(self, sizes_hw: Iterable[tuple[int, int]]) -> None:
        """Run on grey images, once for each network input size that images of `sizes_hw` have.

        The first runs at each size are slow. Raises InferenceError like `detect`.
        """
        for network_hw in dict.fromkeys(map(self.network_hw, sizes_hw)):
            grey = np.full((*network_hw, 3), PADDING_VALUE, np.uint8)
            for _ in range(2):
                predictions = self.runtime(grey, "rgb", Selection().min_objectness)
                self._check(predictions.rows)
                if predictions.compute_prototypes is not None:
                    predictions.compute_prototypes()
                del predictions  # beside those of another run they would take their memory twice

    def streams(self, count: int, threads: int) -> tuple[Detector, ...]:
        """Detectors of the same network for `count` threads at the same time; see `Runtime.streams`."""
        runtimes = self.runtime.streams(count, threads)
        detectors = tuple(copy(self) for _ in runtimes)
        for detector, runtime in zip(detectors, runtimes, strict=True):
            detector.runtime, detector.in_use = runtime, threading.RLock()
        return detectors

    def close(self) -> None:
        """Free the network. Idempotent."""
        self.runtime.close()

    def _check(self, raw: NDArray[np.float32]) -> None:
        outputs = 5 + len(self.class_names) + self.mask_coefficients
        if raw.ndim != 2 or raw.shape[1] != outputs or raw.dtype != np.float32:
            raise InferenceError(
                f"Expected float32 predictions of shape (N, {outputs}) for {len(self.class_names)} classes, "
                f"found {raw.dtype} of shape {raw.shape}."
            )
        if not np.isfinite(raw).all():
            raise InferenceError(
                "The network's predictions are not finite numbers. Check the weights file; with precision "
                "'fp16' try 'fp32'."
            )


def _counts(selection: Selection, letterbox: Letterbox) -> Counts | None:
    """Which boxes in network pixels count; None if all do."""
    if (box_filter := selection.box_filter) is None:
        return None
    return lambda boxes_xyxy: box_filter.admits(letterbox.undo(boxes_xyxy), letterbox.source_hw)


def _masks(
    compute_prototypes: Callable[[], NDArray[np.float32]],
    coefficients: NDArray[np.float32],
    source_hw: tuple[int, int],
) -> Masks:
    """The masks of detections; without detections, no prototypes are computed. Raises InferenceError."""
    if not len(coefficients):
        return Masks(np.empty((coefficients.shape[1], 1, 1), np.float32), coefficients, source_hw)
    prototypes = compute_prototypes()
    if len(prototypes) != coefficients.shape[1] or not np.isfinite(prototypes).all():
        raise InferenceError(
            f"Expected {coefficients.shape[1]} prototypes of masks, all finite numbers, found others, of "
            f"shape {prototypes.shape}. Check the weights file; with precision 'fp16' try 'fp32'."
        )
    return Masks.in_image(prototypes, coefficients, source_hw)


def check_image_size(image_size: int, stride: int) -> None:
    """Raise ValueError unless `image_size` is a positive multiple of `stride`."""
    if problem := image_size_problem(image_size, stride, whose="this model"):
        raise ValueError(f"Image size {problem}")
