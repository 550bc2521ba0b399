"""From settings to a loaded model, or to an error that leaves nothing behind."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest
from support.random_model import random_model
from support.runtime_names import EVERY_RUNTIME
from support.small_families import SMALL_FAMILIES

from benchmark.process_memory import forget_peak, peak_resident_mb, resident_mb
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.detection.prepared_model import prepare_model
from yolov5_lifecycle.models import cost as models_cost
from yolov5_lifecycle.models.cost import cost_of
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.settings import Settings

MAX_GROWN_MB = 100


@pytest.fixture
def tiny(tmp_path: Path) -> Settings:
    """Settings of a model with random weights."""
    write_safetensors(random_model(), tmp_path / "tiny.safetensors")
    weights = str(tmp_path / "tiny.safetensors")
    return Settings(weights=weights, image_size=64, runtime="torch", device="cpu")


def networks() -> int:
    gc.collect()
    return sum(type(each) is Network for each in gc.get_objects())


def test_a_model_that_cannot_predict_is_freed_even_while_its_error_is_kept(tiny: Settings) -> None:
    model = random_model()
    model.state_dict["model.0.conv.weight"][:] = 3e38
    write_safetensors(model, Path(tiny.weights))
    before = networks()
    with pytest.raises(InferenceError, match="not finite") as failure:
        prepare_model(tiny, [(64, 64)])
    assert failure.value.__traceback__ is not None
    assert networks() == before


def test_the_cost_is_told(tiny: Settings) -> None:
    model = prepare_model(tiny, [(64, 64)])
    cost = cost_of(random_model().architecture, (64, 64))
    assert model.facts["cost"] == str(cost)
    assert model.facts["cost"].endswith(" MB at 64x64")


@pytest.mark.long
@pytest.mark.parametrize("runtime_name", ["auto", *EVERY_RUNTIME])
def test_a_model_that_would_take_the_memory_is_refused_without_taking_it(
    runtime_name: str, tmp_path: Path
) -> None:
    """Of its file nothing is wrong: only for large images attention needs too much."""
    path = tmp_path / "transformer.safetensors"
    write_safetensors(random_model(0, SMALL_FAMILIES["transformer"]), path)
    settings = Settings(weights=str(path), runtime=runtime_name, device="cpu")  # type: ignore[arg-type]
    prepare_model(settings.model_copy(update={"image_size": 64}), [(64, 64)]).close()
    before_mb = resident_mb(os.getpid())
    forget_peak()
    with pytest.raises(ValueError, match=r"^Image size 640: layer 2 \(C3TR\) would keep 21\.0 GB .* at most"):
        prepare_model(settings, [(480, 640)])
    assert peak_resident_mb(os.getpid()) - before_mb < MAX_GROWN_MB


@pytest.mark.parametrize("loads", [0, 1], ids=["before it is loaded", "when it is"])
def test_a_model_for_which_the_memory_does_not_suffice_is_refused(
    tiny: Settings, monkeypatch: pytest.MonkeyPatch, loads: int
) -> None:
    available = iter([10**12] * loads + [1_000])
    monkeypatch.setattr(models_cost, "available_bytes", lambda: next(available))
    with pytest.raises(ValueError, match=r"^Image size 64: the model needs .* but only 0 MB are available"):
        prepare_model(tiny, [(64, 64)])
