"""Models written as .safetensors come back the same; anything else is refused."""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save
from support.checkpoint_builder import SMALL
from support.random_model import CLASS_NAMES, random_model, random_network

from yolov5_lifecycle.checkpoints.safetensors_file import (
    FORMAT,
    MAX_HEADER_BYTES,
    read_safetensors,
    write_safetensors,
)
from yolov5_lifecycle.checkpoints.yaml_architecture import MAX_LEVELS
from yolov5_lifecycle.models.architecture import Layer
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


@dataclasses.dataclass
class Parts:
    """A file taken apart, to be spoiled and put together again."""

    header: dict[str, Any]
    body: bytes

    @classmethod
    def of(cls, data: bytes) -> Parts:
        end = 8 + struct.unpack("<Q", data[:8])[0]
        return cls(json.loads(data[8:end]), data[end:])

    def joined(self) -> bytes:
        header = json.dumps(self.header).encode()
        return struct.pack("<Q", len(header)) + header + self.body

    def architecture(self) -> dict[str, Any]:
        described: dict[str, Any] = json.loads(self.header["__metadata__"]["architecture"])
        return described


def refusal(data: bytes) -> str:
    with pytest.raises(WeightsError) as refused:
        read_safetensors(data)
    return str(refused.value)


@pytest.mark.parametrize("half", [True, False], ids=["fp16", "fp32"])
def test_a_model_comes_back_as_it_was_written(half: bool, tmp_path: Path) -> None:
    model = small_model(half=half)
    write_safetensors(model, tmp_path / "a.safetensors")
    again = read_safetensors((tmp_path / "a.safetensors").read_bytes())
    assert (again.architecture, again.class_names) == (model.architecture, model.class_names)
    assert again.state_dict.keys() == model.state_dict.keys()
    for key, tensor in again.state_dict.items():
        assert tensor.dtype is model.state_dict[key].dtype, key
        assert torch.equal(tensor, model.state_dict[key]), key
    Network(again.architecture).load_state_dict(again.state_dict, strict=True)


@pytest.mark.parametrize("levels", [1, MAX_LEVELS], ids=["one", "the most"])
def test_a_model_of_one_level_and_one_of_the_most_come_back(levels: int, tmp_path: Path) -> None:
    architecture = dataclasses.replace(
        SMALL,
        anchors_px=(((10, 13), (16, 30)),) * levels,
        strides=(4,) * levels,
        layers=(*SMALL.layers[:2], Layer((1,) * levels, 1, "Detect")),
    )
    path = tmp_path / "levels.safetensors"
    write_safetensors(random_model(0, architecture), path)
    assert read_safetensors(path.read_bytes()).architecture == architecture


def test_what_was_fp16_takes_two_bytes_a_number_and_what_was_not_takes_four(tmp_path: Path) -> None:
    dtypes = []
    for half in (True, False):
        write_safetensors(small_model(half=half), tmp_path / "a.safetensors")
        dtypes.append(Parts.of((tmp_path / "a.safetensors").read_bytes()).header[CONVOLUTION]["dtype"])
    assert dtypes == ["F16", "F32"]


def test_equal_models_make_equal_files(written: bytes, tmp_path: Path) -> None:
    write_safetensors(small_model(), tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == written


def test_a_write_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "taken.safetensors").mkdir()
    with pytest.raises(OSError, match="directory"):
        write_safetensors(small_model(), tmp_path / "taken.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["taken.safetensors"]


def _metadata(**entries: object) -> Callable[[Parts], object]:
    return lambda parts: parts.header["__metadata__"].update(entries)


def _architecture(**fields: object) -> Callable[[Parts], object]:
    return lambda parts: parts.header["__metadata__"].update(
        architecture=json.dumps(parts.architecture() | fields)
    )


def _layer(index: int, row: object) -> Callable[[Parts], object]:
    def spoil(parts: Parts) -> None:
        described = parts.architecture()
        described["layers"][index] = row
        parts.header["__metadata__"]["architecture"] = json.dumps(described)

    return spoil


def _entry(**fields: object) -> Callable[[Parts], object]:
    return lambda parts: parts.header[CONVOLUTION].update(fields)


def _number(key: str, value: float) -> Callable[[Parts], object]:
    """The first number of a tensor of halves."""

    def spoil(parts: Parts) -> None:
        entry = parts.header[key]
        assert entry["dtype"] == "F16"
        start = entry["data_offsets"][0]
        parts.body = parts.body[:start] + struct.pack("<e", value) + parts.body[start + 2 :]

    return spoil


def _reinterpreted(parts: Parts) -> None:
    """Integers where the network has floats: the bytes of four halves as one int64."""
    shape = parts.header[CONVOLUTION]["shape"]
    parts.header[CONVOLUTION].update(dtype="I64", shape=[*shape[:-1], shape[-1] // 2, 1][:4])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        pytest.param(_metadata(format="another 1"), "was not written by this package", id="another format"),
        pytest.param(
            lambda parts: parts.header.pop("__metadata__"), "was not written by this", id="no metadata"
        ),
        pytest.param(
            lambda parts: parts.header.update(__metadata__=[1]), "was not written by", id="a list of it"
        ),
        pytest.param(_metadata(architecture="{"), "entry architecture is missing or damaged", id="no json"),
        pytest.param(_metadata(architecture=["x"]), "entry architecture is missing or damaged", id="no text"),
        pytest.param(
            _metadata(architecture="[" * 100_000), "entry architecture is missing", id="json nested"
        ),
        pytest.param(
            _metadata(architecture="[]"), "entry architecture is damaged", id="json of another kind"
        ),
        pytest.param(_metadata(class_names="nonsense"), "entry class_names is missing", id="names no json"),
        pytest.param(_metadata(class_names='["cat"]'), "names of 3 classes, found 1 names", id="few names"),
        pytest.param(_metadata(class_names='["a", "b", {}]'), "numbers, found a dict", id="no name"),
        pytest.param(
            _metadata(class_names=json.dumps(["a", "b", "c" * 201])),
            "a class name of 201 characters, more than 200: convert the original .pt again",
            id="long name",
        ),
        pytest.param(_architecture(classes=0), "number of classes: expected an integer", id="no class"),
        pytest.param(_architecture(classes=10**9), "number of classes: expected", id="many classes"),
        pytest.param(_architecture(classes=True), "number of classes: expected", id="classes true"),
        pytest.param(_architecture(classes=4), "names of 4 classes, found 3 names", id="one class more"),
        pytest.param(_architecture(strides=[8, 16]), "the strides are [8, 16], but its layers", id="strides"),
        pytest.param(
            _architecture(strides=[4.0, 8.0]), "stride: expected an integer", id="fractional stride"
        ),
        pytest.param(_architecture(strides=[]), "equally many anchors", id="no strides"),
        pytest.param(_architecture(strides=[4] * 10**5), "equally many anchors", id="many strides"),
        pytest.param(_architecture(anchors_px=[]), "equally many anchors", id="no anchors"),
        pytest.param(_architecture(anchors_px=[[], []]), "anchors of a level: expected", id="empty levels"),
        pytest.param(_architecture(anchors_px=[[[1, 2]], [[1, 2]] * 2]), "equally many anchors", id="uneven"),
        pytest.param(_architecture(anchors_px=[[[1]], [[1]]]), "architecture is damaged", id="no heights"),
        pytest.param(
            _architecture(anchors_px=[[[10**400, 1]]] * 2), "architecture is damaged", id="overflow"
        ),
        pytest.param(
            _architecture(anchors_px=[[[9, 9], [9, 9]]] * 2),
            "are not those of the architecture",
            id="anchors",
        ),
        pytest.param(
            _architecture(anchors_px=[[[float("nan")] * 2] * 2] * 2), "not those of the", id="anchors nan"
        ),
        pytest.param(_architecture(depth_multiple=float("inf")), "depth_multiple from 0.01", id="depth inf"),
        pytest.param(_architecture(width_multiple="1"), "width_multiple from 0.01 to 10", id="width a text"),
        pytest.param(_architecture(width_multiple=1e-9), "width_multiple from 0.01 to 10", id="width tiny"),
        pytest.param(
            _architecture(width_multiple=0.5), "has the shape (8, 3, 6, 6), expected (32,", id="wide"
        ),
        pytest.param(_architecture(layers=[]), "expected 1 to 200 layers, found 0", id="no layers"),
        pytest.param(_architecture(layers=[[[-1], 1, "Conv", [8]]] * 201), "found 201", id="many layers"),
        pytest.param(_architecture(layers={"a": 1}), "architecture is damaged", id="layers a dict"),
        pytest.param(
            _layer(0, [[-1], 1, "Focus", [64, 3]]), "model.0.conv.conv.weight is missing", id="Focus"
        ),
        pytest.param(_layer(0, [[-1], 1, [], [64]]), "layer 0 is a '[]', not supported", id="kind a list"),
        pytest.param(_layer(0, [[-1], 1, "Conv", [64, 6]]), "not supported", id="even kernel at stride 1"),
        pytest.param(_layer(0, [[-1], 1, "Conv", [64, 6, 2, 99]]), "the padding of layer 0", id="padding"),
        pytest.param(_layer(0, [[-1], 1, "Conv", []]), "the channels of layer 0", id="no arguments"),
        pytest.param(_layer(0, [[-1], 1, "Conv", [10**9, 6, 2]]), "the channels of layer 0", id="channels"),
        pytest.param(_layer(0, [[-1], 9, "Conv", [64, 6, 2]]), "cannot be repeated", id="repeats"),
        pytest.param(_layer(5, [[-1], 9, "Upsample", []]), "is repeated 3 times", id="repeated upsampling"),
        pytest.param(_architecture(image_channels=2), "reads images of 2 channels", id="channels of images"),
        pytest.param(_architecture(channel_multiple=0), "the channel_multiple", id="channel multiple"),
        pytest.param(_architecture(activation="eval"), "expected an activation", id="activation"),
        pytest.param(_architecture(activation=["SiLU"]), "expected an activation", id="activation a list"),
        pytest.param(_architecture(activation="LeakyReLU(9)"), "expected an activation", id="steep slope"),
        pytest.param(_architecture(is_fused=1), "true or false as is_fused", id="fused a number"),
        pytest.param(_architecture(is_fused=True), "model.0.conv.bias is missing", id="fused"),
        pytest.param(_architecture(other_activations={}), "expected pairs", id="other activations a dict"),
        pytest.param(_architecture(other_activations=[["a", "b", "c"]]), "expected pairs", id="triples"),
        pytest.param(
            _architecture(other_activations=[["model.0.bn", "ReLU"]]),
            "there is no activation at model.0.bn",
            id="activation of what has none",
        ),
        pytest.param(_layer(2, [[-1], 10**6, "C3", [64]]), "the number of layer 2", id="bottlenecks"),
        pytest.param(_layer(2, [[-1], 3, "C3", [64, 2]]), "not supported", id="shortcut 2"),
        pytest.param(_layer(0, [[0], 1, "Conv", [64, 6, 2]]), "the input of layer 0", id="reads itself"),
        pytest.param(_layer(1, [[5], 1, "Conv", [64, 3, 2]]), "the input of layer 1", id="reads later"),
        pytest.param(_layer(1, [[-3], 1, "Conv", [64, 3, 2]]), "the input of layer 1", id="before the first"),
        pytest.param(_layer(1, [[-1, 0], 1, "Conv", [64, 3, 2]]), "reads too many layers", id="two inputs"),
        pytest.param(_layer(1, [[], 1, "Conv", [64, 3, 2]]), "reads 0 layers", id="no input"),
        pytest.param(_layer(6, [[-1, 0], 1, "Concat", []]), "joins layers of different", id="sizes differ"),
        pytest.param(_layer(7, [[7, 4], 1, "Detect", []]), "the input of layer 7", id="Detect reads itself"),
        pytest.param(_layer(7, [[6, 4], 1, "Detect", []]), "expected one Detect or", id="two Detects"),
        pytest.param(_layer(8, [[-1], 1, "Conv", [64, 1, 1]]), "expected one Detect or", id="no Detect"),
        pytest.param(
            _layer(8, [[7, 4], 1, "Segment", [257, 64]]),
            "coefficients of masks of layer 8: expected an integer from 1 to 256",
            id="many prototypes",
        ),
        pytest.param(
            _layer(8, [[7, 4], 1, "Segment", [8, 64]]), "model.8.m.0.weight has the shape", id="no masks"
        ),
        pytest.param(_entry(dtype="F8_E4M3"), "holds 'F8_E4M3', expected one of", id="number format"),
        pytest.param(_entry(dtype=["F16"]), "expected one of F16", id="number format a list"),
        pytest.param(
            _entry(shape=[1 << 40]), "has the shape (1099511627776,)", id="shape larger than its data"
        ),
        pytest.param(_entry(data_offsets=[0, 1 << 50]), "damaged, or cut short", id="data beyond the file"),
        pytest.param(_entry(shape=[[1]]), "has the shape [a list]", id="shape of lists"),
        pytest.param(_entry(shape=None), "has the shape None", id="no shape"),
        pytest.param(_entry(shape=[1 << 62, 1 << 62]), "has the shape", id="shape beyond all numbers"),
        pytest.param(_entry(data_offsets=[0, 8]), "damaged, or cut short", id="data overlaps"),
        pytest.param(_entry(data_offsets=[-8, 0]), "damaged, or cut short", id="data before the file"),
        pytest.param(lambda parts: parts.header.update(x=5), "expected one of F16", id="entry no dict"),
        pytest.param(lambda parts: parts.header.pop(CONVOLUTION), "conv.weight is missing", id="hole"),
        pytest.param(_reinterpreted, "has the shape (8, 3, 6, 3)", id="other format of the same bytes"),
        pytest.param(_number(CONVOLUTION, float("nan")), "not finite", id="NaN"),
        pytest.param(_number(CONVOLUTION, float("-inf")), "not finite", id="infinity"),
        pytest.param(_number(VARIANCES, -1.0), "negative variances", id="negative variance"),
        pytest.param(_number(ANCHORS, 0.0), "positive width and height", id="anchor without width"),
        pytest.param(_number(ANCHORS, 9.0), "are not those of the architecture", id="another anchor"),
    ],
)
def test_a_damaged_file_is_refused(spoil: Callable[[Parts], object], message: str, written: bytes) -> None:
    parts = Parts.of(written)
    spoil(parts)
    assert message in refusal(parts.joined())


def test_a_tensor_of_no_layer_is_refused_before_any_tensor_is_loaded(written: bytes) -> None:
    parts = Parts.of(written)
    parts.header["extra"] = {"dtype": "F32", "shape": [1 << 29], "data_offsets": [1 << 40, 1 << 41]}
    assert "'extra' belongs to no layer" in refusal(parts.joined())


@pytest.mark.parametrize(
    ("data", "message"),
    [
        pytest.param(b"", "found 0 bytes", id="empty"),
        pytest.param(b"\0" * 7, "found 7 bytes", id="shorter than its length"),
        pytest.param(b"\0" * 4096, "its header is not JSON", id="zeros"),
        pytest.param(struct.pack("<Q", 1 << 62) + b"{}", "its header does not fit", id="endless header"),
        pytest.param(struct.pack("<Q", MAX_HEADER_BYTES + 1), "its header does not fit", id="large header"),
        pytest.param(struct.pack("<Q", 4) + b"[[]]", "its header is [a list]", id="header a list"),
        pytest.param(struct.pack("<Q", 10**5) + b"[" * 10**5, "its header is not JSON", id="header nested"),
        pytest.param(b"<!DOCTYPE html><html></html>", "its header does not fit", id="html"),
        pytest.param(b"PK\x03\x04" + b"\0" * 100, "its header", id="zip"),
        pytest.param(save({"a": torch.zeros(3)}), "was not written by this package", id="another program's"),
        pytest.param(
            save({"a": torch.zeros(3)}, metadata={"format": FORMAT}), "architecture is missing", id="forged"
        ),
    ],
)
def test_another_kind_of_file_is_refused(data: bytes, message: str) -> None:
    assert message in refusal(data)


@pytest.mark.parametrize("surplus", [1, 4096])
def test_bytes_after_the_last_tensor_are_refused(written: bytes, surplus: int) -> None:
    assert "damaged, or cut short" in refusal(written + b"\0" * surplus)


@pytest.mark.long
@given(kept=st.floats(0, 1, exclude_max=True))
def test_a_part_of_a_file_is_refused(written: bytes, kept: float) -> None:
    assert refusal(written[: int(kept * len(written))])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param({CONVOLUTION: None}, "the tensor model.0.conv.weight is missing", id="missing"),
        pytest.param({"extra": torch.zeros(1)}, "'extra' belongs to no layer", id="one more"),
        pytest.param({"\n\x1b[2J": torch.zeros(1)}, "'\\n\\x1b[2J' belongs to no layer", id="odd name"),
        pytest.param({VARIANCES: torch.zeros(9)}, "has the shape (9,), expected (8,)", id="shape"),
        pytest.param({VARIANCES: torch.zeros(8, dtype=torch.int64)}, "holds torch.int64", id="integers"),
        pytest.param(
            {VARIANCES: torch.full((8,), 1e300, dtype=torch.float64)},
            "not finite",
            id="too large for float32",
        ),
        pytest.param({VARIANCES: torch.zeros(8, dtype=torch.bool)}, "holds 'BOOL'", id="booleans"),
    ],
)
def test_tensors_that_do_not_fit_are_refused(
    change: dict[str, torch.Tensor | None], message: str, written: bytes
) -> None:
    metadata = Parts.of(written).header["__metadata__"]
    changed = {**small_model().state_dict, **change}
    tensors = {key: tensor for key, tensor in changed.items() if tensor is not None}
    assert message in refusal(save(tensors, metadata=metadata))


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16], ids=str)
def test_any_float_format_is_read_as_float32(dtype: torch.dtype, written: bytes) -> None:
    tensors = {
        key: tensor.to(dtype) if tensor.is_floating_point() else tensor.to(torch.int32)
        for key, tensor in small_model().state_dict.items()
    }
    tensors[ANCHORS] = small_model().state_dict[ANCHORS]
    model = read_safetensors(save(tensors, metadata=Parts.of(written).header["__metadata__"]))
    assert {tensor.dtype for tensor in model.state_dict.values()} == {torch.float32, torch.int64}
    assert torch.equal(model.state_dict[CONVOLUTION], tensors[CONVOLUTION].float())
