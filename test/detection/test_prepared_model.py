"""From settings to a loaded model, or to an error that leaves nothing behind."""

from __future__ import annotations

import gc
import re
from pathlib import Path

import pytest
from support.random_model import random_model
from support.small_families import SMALL_FAMILIES

from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.detection.prepared_model import prepare_model
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.settings import Settings


def networks() -> int:
    gc.collect()
    return sum(type(each) is Network for each in gc.get_objects())


def test_a_model_that_cannot_predict_is_freed_even_while_its_error_is_kept(tmp_path: Path) -> None:
    model = random_model()
    model.state_dict["model.0.conv.weight"][:] = 3e38
    path = tmp_path / "broken.safetensors"
    write_safetensors(model, path)
    before = networks()
    with pytest.raises(InferenceError, match="not finite") as failure:
        prepare_model(Settings(weights=str(path), image_size=64, runtime="torch"), [(64, 64)])
    assert failure.value.__traceback__ is not None
    assert networks() == before


@pytest.fixture
def tiny(tmp_path: Path) -> Settings:
    """Settings of a model with random weights."""
    path = tmp_path / "tiny.safetensors"
    write_safetensors(random_model(), path)
    return Settings(weights=str(path), image_size=64, runtime="torch", device="cpu")


def test_batches_are_measured_for_several_cameras_and_reported(tiny: Settings) -> None:
    model = prepare_model(tiny.model_copy(update={"max_batch": 8}), [(64, 64)] * 3)
    assert set(model.detector.batch_sizes) <= {2, 3}
    told = model.facts["batches"]
    assert re.fullmatch(r"(none|of [23]( or 3)?): single .* ms an image, .*", told)
    assert f"batches {told}" in model.summary


def test_one_camera_or_no_batches_are_not_measured(tiny: Settings) -> None:
    batched = tiny.model_copy(update={"max_batch": 8})
    assert prepare_model(batched, [(64, 64)]).facts["batches"] == "none: there is only one camera"
    model = prepare_model(tiny, [(64, 64)] * 3)
    assert "batches" not in model.facts
    assert model.detector.batch_sizes == ()


def test_only_a_model_that_segments_reports_masks(tiny: Settings, tmp_path: Path) -> None:
    path = tmp_path / "segmentation.safetensors"
    write_safetensors(random_model(0, SMALL_FAMILIES["segmentation"]), path)
    model = prepare_model(tiny.model_copy(update={"weights": str(path)}), [(64, 64)])
    assert model.detector.segments
    assert model.facts["masks"] == "8 coefficients"
    detection_model = prepare_model(tiny, [(64, 64)])
    assert not detection_model.detector.segments
    assert "masks" not in detection_model.facts
