"""From settings to a model that is ready, or to nothing at all."""

from __future__ import annotations

import gc
from pathlib import Path

import pytest
from support.random_model import random_model

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
