"""The public Python API: `load_model`, exported by `yolov5_lifecycle` with the types of what it returns."""

from __future__ import annotations

import os
from collections.abc import Sequence

from yolov5_lifecycle.detection.class_filter import model_problems, selection_of
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector
from yolov5_lifecycle.detection.prepared_model import prepare_model
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME, validated


def load_model(
    weights: str | os.PathLike[str],
    *,
    weights_sha256: str = "",
    device: str | int = "auto",
    runtime: str = "auto",
    precision: str = "auto",
    image_size: int = 640,
    confidence_threshold: float = 0.25,
    iou_threshold: float = 0.45,
    max_detections: int = 1000,
    classes: Sequence[str | int] = (),
    class_thresholds: Sequence[str] = (),
    regions: Sequence[str] = (),
    ignore_regions: Sequence[str] = (),
    region_anchor: str = "center",
    min_box_size: float = 0.0,
    max_box_size: float = 0.0,
    agnostic_nms: bool = False,
) -> Detector:
    """Load weights (.pt, .safetensors or .onnx) and warm the network up: a detector to call with images.

    The arguments are the node's parameters of the same names, with their defaults and rules. `weights` may
    begin with ~ or package://PACKAGE. Sets no environment variable, unlike the commands; docs/performance.md
    says which matter.

    Raises SettingsError with every invalid argument, WeightsError for the file, DeviceError also
    for a runtime that is absent, all ValueErrors; OSError; InferenceError.
    """
    values: dict[str, object] = {**locals(), "weights": os.fspath(weights)}
    settings = validated({name: SETTINGS_BY_NAME[name].coerced(value) for name, value in values.items()})
    model = prepare_model(settings, [USUAL_SOURCE_HW])
    if problems := model_problems(settings, model.detector.class_names):
        model.close()
        raise SettingsError(problems)
    model.detector.selection = selection_of(settings, model.detector.class_names)
    return model.detector
