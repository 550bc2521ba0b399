"""Detector: letterbox, inference and NMS for one image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.nms import Selection, select
from yolov5_lifecycle.images.image import Picture
from yolov5_lifecycle.models.architecture import image_size_problem
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.auto import Choice, choose_runtime
from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime

USUAL_SOURCE_HW = (480, 640)


class Detector:
    """Detects objects in images. Owns `runtime`; stateless between images.

    `class_names` by class id. `image_size`: longer side of the network input in pixels, a multiple of
    `stride`, the largest stride of the model; else ValueError. `choice`: why this runtime was selected.
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
        _check_image_size(image_size, stride)
        self.runtime = runtime
        self.choice = choice
        self.class_names = tuple(class_names)
        self.image_size = image_size
        self.stride = stride

    def detect(self, picture: Picture, selection: Selection) -> Detections:
        """Detections in pixels of `picture`, clipped to it; boxes entirely in the padding are dropped.

        Raises InferenceError when the network fails or its predictions are invalid.
        """
        letterbox = Letterbox.fit(picture.size_hw, image_size=self.image_size, stride=self.stride)
        frame = letterbox.apply(picture.pixels)
        raw = self.runtime(frame, picture.order, selection.least_objectness)
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
        picture = Picture(np.full((*source_hw, 3), 114, np.uint8), "rgb")
        for _ in range(2):
            self.detect(picture, Selection())

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


def load_detector(
    model: Model,
    *,
    device: str = "auto",
    precision: str = "auto",
    image_size: int = 640,
    runtime: str = "auto",
) -> Detector:
    """Load a detector for `model`; the other arguments are the settings of the same names.

    With `auto` the fastest runtime is measured and cached, see `choose_runtime`. Raises DeviceError and
    RuntimeAbsentError (both ValueErrors), ValueError for the image size, InferenceError when measuring fails.
    """
    stride = max(model.architecture.strides)
    _check_image_size(image_size, stride)
    choice = Choice(runtime, "as set")
    if runtime == "auto":
        frame_hw = Letterbox.fit(USUAL_SOURCE_HW, image_size=image_size, stride=stride).network_hw
        choice = choose_runtime(model, device=device, precision=precision, frame_hw=frame_hw)
    loaded = load_runtime(model, choice.runtime, device=device, precision=precision)
    return Detector(
        loaded, class_names=model.class_names, image_size=image_size, stride=stride, choice=choice.reason
    )


def _check_image_size(image_size: int, stride: int) -> None:
    if problem := image_size_problem(image_size, stride, whose="this model"):
        raise ValueError(f"Image size {problem}")
