"""Detector: letterbox, inference and NMS for one image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.nms import Selection, select
from yolov5_lifecycle.images.image import ColourImage, Order
from yolov5_lifecycle.models.architecture import image_size_problem
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime

USUAL_SOURCE_HW = (480, 640)


class Detector:
    """Detects objects in images; for one thread at a time. Owns `runtime`; stateless between images.

    `class_names` by class id. `image_size`: longer side of the network input in pixels, a multiple of
    `stride`, the largest stride of the model; else ValueError. `choice`: why this runtime was selected.
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
    ) -> None:
        check_image_size(image_size, stride)
        self.runtime = runtime
        self.choice = choice
        self.class_names = tuple(class_names)
        self.image_size = image_size
        self.stride = stride
        self.selection = Selection()
        self.batch_sizes: tuple[int, ...] = ()

    def __call__(self, pixels: NDArray[np.uint8], *, order: Order = "bgr") -> Detections:
        """Detections in an image (H, W, 3) of dtype uint8, as cv2.imread returns it; see `detect`.

        Raises ImageError for anything else, such as None from cv2.imread.
        """
        return self.detect(ColourImage(pixels, order), self.selection)

    def detect(self, image: ColourImage, selection: Selection) -> Detections:
        """Detections in pixels of `image`, clipped to it; boxes entirely in the padding are dropped.

        Raises InferenceError when the network fails or its predictions are invalid.
        """
        letterbox = Letterbox.fit(image.size_hw, image_size=self.image_size, stride=self.stride)
        frame = letterbox.apply(image.pixels)
        raw = self.runtime(frame, image.order, selection.min_objectness)
        self._check(raw)
        found = select(raw, selection)
        boxes_xyxy = letterbox.undo(found.boxes_xyxy)
        visible = (boxes_xyxy[:, :2] < boxes_xyxy[:, 2:]).all(axis=1)
        return Detections(
            boxes_xyxy[visible], found.scores[visible], found.class_ids[visible], found.best_missed
        )

    def warm_up(self, source_hw: tuple[int, int]) -> None:
        """Run on grey images of size `source_hw`, as the first runs at each size are slow.

        Raises InferenceError like `detect`.
        """
        image = ColourImage(np.full((*source_hw, 3), 114, np.uint8), "rgb")
        for _ in range(2):
            self.detect(image, Selection())

    def close(self) -> None:
        """Free the network. Idempotent."""
        self.runtime.close()

    def _check(self, raw: NDArray[np.float32]) -> None:
        outputs = 5 + len(self.class_names)
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


def check_image_size(image_size: int, stride: int) -> None:
    """Raise ValueError unless `image_size` is a positive multiple of `stride`."""
    if problem := image_size_problem(image_size, stride, whose="this model"):
        raise ValueError(f"Image size {problem}")
