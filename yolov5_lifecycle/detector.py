"""One picture in, detections out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.boxes import Selection, select
from yolov5_lifecycle.detections import Detections
from yolov5_lifecycle.images import Picture
from yolov5_lifecycle.letterbox import Letterbox
from yolov5_lifecycle.model import Model
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime


class Detector:
    """Finds the objects of `class_names` in pictures. Owns `runtime`; keeps nothing between pictures.

    `image_size`: longer side of the network frame in pixels, a multiple of `stride`, else ValueError.
    """

    def __init__(self, runtime: Runtime, *, class_names: Sequence[str], image_size: int, stride: int) -> None:
        check_image_size(image_size, stride)
        self.runtime = runtime
        self.class_names = tuple(class_names)
        self.image_size = image_size
        self.stride = stride

    def detect(self, picture: Picture, selection: Selection) -> Detections:
        """Detections in pixels of `picture`, clipped to it, best first.

        Raises InferenceError when the network fails or its predictions are not finite numbers of the right shape.
        """
        letterbox = Letterbox.fit(picture.size_hw, image_size=self.image_size, stride=self.stride)
        raw = self.runtime(letterbox.apply(picture.pixels), picture.order)
        self._check(raw)
        found = select(raw, selection)
        return Detections(letterbox.undo(found.boxes_xyxy), found.scores, found.class_ids)

    def warm_up(self, source_hw: tuple[int, int] = (480, 640)) -> None:
        """Detect in an empty picture as large as those to come: the first run of a shape is slow.

        Raises InferenceError like `detect`.
        """
        empty = Picture(np.zeros((*source_hw, 3), np.uint8), "rgb")
        for _ in range(2):
            self.detect(empty, Selection())

    def close(self) -> None:
        """Free the network."""
        self.runtime.close()

    def _check(self, raw: NDArray[np.float32]) -> None:
        outputs = 5 + len(self.class_names)
        if raw.ndim != 2 or raw.shape[1] != outputs or raw.dtype != np.float32:
            raise InferenceError(
                f"Expected float32 predictions of shape (N, {outputs}) for {len(self.class_names)} classes, "
                f"found {raw.dtype} of shape {raw.shape}."
            )
        if not np.isfinite(raw.sum()):
            raise InferenceError(
                "The network's predictions are not finite (NaN or infinity): check the weights file, and use "
                "precision 'fp32' if it is 'fp16'."
            )


def load_detector(
    model: Model, *, device: str = "auto", precision: str = "auto", image_size: int = 640, runtime: str = "auto"
) -> Detector:
    """A detector for `model`, with the words of the settings of the same names.

    Raises DeviceError when the device is absent, ValueError for an unfit image size or unknown runtime.
    """
    stride = max(model.architecture.strides)
    check_image_size(image_size, stride)
    if runtime not in ("auto", "torch"):
        raise ValueError(f"Runtime must be auto or torch, found '{runtime[:40]}'.")
    return Detector(
        TorchRuntime.load(model, device=device, precision=precision),
        class_names=model.class_names,
        image_size=image_size,
        stride=stride,
    )


def check_image_size(image_size: int, stride: int) -> None:
    """Raise ValueError with the nearest good values unless `image_size` is a positive multiple of `stride`."""
    if image_size < stride or image_size % stride:
        below = max(image_size // stride, 1) * stride
        raise ValueError(
            f"The image size {image_size} is not a multiple of {stride}, the largest stride of this model. "
            f"Use {below} or {below + stride}."
        )
