"""Models written as .safetensors come back the same; see test_hostile_files.py for what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from safetensors.torch import save
from support.checkpoint_builder import SMALL, assert_same
from support.hostile_safetensors import parted
from support.random_model import CLASS_NAMES, random_model, random_network
from support.small_families import SMALL_FAMILIES

from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors, write_safetensors
from yolov5_lifecycle.checkpoints.yaml_architecture import MAX_LEVELS
from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.model import Model, WeightsError
from yolov5_lifecycle.models.network import Network

CONVOLUTION = "model.0.conv.weight"
VARIANCES = "model.0.bn.running_var"
ANCHORS = "model.8.anchors"


def small_model(*, half: bool = True) -> Model:
    network = random_network(0, SMALL)
    return Model(SMALL, CLASS_NAMES, (network.half() if half else network).float().state_dict())


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("written") / "small.safetensors"
    write_safetensors(small_model(), path)
    return path.read_bytes()


@pytest.mark.parametrize(("half", "dtype"), [(True, "F16"), (False, "F32")], ids=["fp16", "fp32"])
def test_a_model_comes_back_as_it_was_written_in_no_more_bytes(
    half: bool, dtype: str, tmp_path: Path
) -> None:
    model = small_model(half=half)
    write_safetensors(model, tmp_path / "a.safetensors")
    data = (tmp_path / "a.safetensors").read_bytes()
    assert parted(data)[0][CONVOLUTION]["dtype"] == dtype
    again = read_safetensors(data)
    assert_same(again, model)
    Network(again.architecture).load_state_dict(again.state_dict, strict=True)


def of_levels(count: int) -> Architecture:
    return dataclasses.replace(
        SMALL,
        anchors_px=(((10, 13), (16, 30)),) * count,
        strides=(4,) * count,
        layers=(*SMALL.layers[:2], Layer((1,) * count, 1, "Detect")),
    )


@pytest.mark.parametrize(
    "architecture",
    [
        pytest.param(of_levels(1), id="one level"),
        pytest.param(of_levels(MAX_LEVELS), id="the most levels"),
        pytest.param(SMALL_FAMILIES["convolutions"], id="activations that differ"),
    ],
)
def test_an_unusual_architecture_comes_back(architecture: Architecture, tmp_path: Path) -> None:
    write_safetensors(random_model(0, architecture), tmp_path / "a.safetensors")
    assert read_safetensors((tmp_path / "a.safetensors").read_bytes()).architecture == architecture


def test_equal_models_make_equal_files(written: bytes, tmp_path: Path) -> None:
    write_safetensors(small_model(), tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == written


def test_a_write_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "taken.safetensors").mkdir()
    with pytest.raises(OSError, match="directory"):
        write_safetensors(small_model(), tmp_path / "taken.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["taken.safetensors"]


@pytest.mark.parametrize(
    ("variances", "message"),
    [
        pytest.param(torch.zeros(8, dtype=torch.int64), "holds torch.int64", id="integers"),
        pytest.param(torch.full((8,), 1e300, dtype=torch.float64), "not finite", id="too large for float32"),
        pytest.param(torch.full((8,), -1.0), "negative variances", id="negative"),
    ],
)
def test_numbers_that_no_training_leaves_are_refused(
    variances: torch.Tensor, message: str, written: bytes
) -> None:
    tensors = {**small_model().state_dict, VARIANCES: variances}
    with pytest.raises(WeightsError, match=message):
        read_safetensors(save(tensors, metadata=parted(written)[0]["__metadata__"]))


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16], ids=str)
def test_any_float_format_is_read_as_float32(dtype: torch.dtype, written: bytes) -> None:
    tensors = {
        key: tensor.to(dtype) if tensor.is_floating_point() else tensor.to(torch.int32)
        for key, tensor in small_model().state_dict.items()
    }
    tensors[ANCHORS] = small_model().state_dict[ANCHORS]
    model = read_safetensors(save(tensors, metadata=parted(written)[0]["__metadata__"]))
    assert {tensor.dtype for tensor in model.state_dict.values()} == {torch.float32, torch.int64}
    assert torch.equal(model.state_dict[CONVOLUTION], tensors[CONVOLUTION].float())
