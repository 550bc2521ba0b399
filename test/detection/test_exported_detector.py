"""A detector of an export to ONNX: its size decides, and what contradicts it is refused with what to type."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import hostile_onnx
from support.onnx_exports import NAMES, small_export

from yolov5_lifecycle.checkpoints.onnx_file import read_onnx
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import load_detector, prepare_model
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models import cost as models_cost
from yolov5_lifecycle.settings.settings import Settings

IMAGE = ColourImage(np.random.default_rng(0).integers(0, 256, (90, 200, 3), np.uint8), "bgr")
LIKELY = Selection(confidence_threshold=0.1, with_masks=True, with_embedding=True)


def detector(*, image_size: int = 96, **options: Any) -> Detector:
    return load_detector(read_onnx(small_export(**options)), image_size=image_size)


def test_an_image_is_placed_in_the_only_size_that_the_export_takes() -> None:
    fixed = detector(size_hw=(64, 96))
    assert fixed.network_hw((90, 200)) == fixed.network_hw((200, 90)) == (64, 96)
    assert fixed.streams(1, 1)[0].network_hw((200, 90)) == (64, 96)
    assert detector(size_hw=None).network_hw((200, 90)) == (96, 64)
    assert len(fixed.detect(IMAGE, LIKELY)) > 0


def test_masks_are_found_and_looks_are_empty() -> None:
    found = detector(masks=4, has_objectness=False).detect(IMAGE, LIKELY)
    assert found.masks is not None
    assert found.masks.label_image(found.boxes_xyxy).shape == IMAGE.size_hw
    assert found.embedding is not None
    assert found.embedding.shape == (0,)


@pytest.mark.parametrize(
    ("image_size", "size_hw", "told"),
    [
        pytest.param(640, (64, 96), "takes images of 96x64 only. Set image_size to 96.", id="larger"),
        pytest.param(64, (64, 96), "Set image_size to 96.", id="its shorter side"),
        pytest.param(80, None, "80 is not a multiple of 32", id="no multiple of the stride"),
    ],
)
def test_another_size_is_refused_with_what_to_type(
    image_size: int, size_hw: tuple[int, int] | None, told: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(told)):
        detector(image_size=image_size, size_hw=size_hw)


def test_a_cost_that_grows_out_of_proportion_is_refused_before_a_runtime_loads_it() -> None:
    with pytest.raises(ValueError, match="elements are computed"):
        load_detector(read_onnx(hostile_onnx.every_place_with_every_other()), image_size=4096)


def test_too_little_memory_is_told_before_a_runtime_loads_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models_cost, "available_bytes", lambda: 1000)
    with pytest.raises(ValueError, match="only 0 MB are available"):
        detector()


def test_settings_select_an_export_like_other_weights(tmp_path: Path) -> None:
    path = tmp_path / "best.onnx"
    path.write_bytes(small_export())
    settings = Settings(weights=str(path), image_size=96)
    prepared = prepare_model(settings, [(48, 96)])
    assert prepared.detector.class_names == NAMES
    prepared.close()
    with pytest.raises(ValueError, match="Precision 'int8' needs the layers"):
        prepare_model(settings.model_copy(update={"precision": "int8"}), [])
