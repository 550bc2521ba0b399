"""ONNX exports of every version are read as the network that they came from; others are refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from onnxruntime import InferenceSession
from support import hostile_onnx
from support.checkpoint_builder import SMALL, official_model, saved, stripped
from support.onnx_exports import exported, model_of, serialized, valid
from support.random_model import random_network
from support.small_families import EVERY_SMALL, SMALL_FAMILIES

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.checkpoints.onnx_file import read_onnx
from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.commands.convert import convert
from yolov5_lifecycle.models.architecture import SIZES, Architecture
from yolov5_lifecycle.models.geometry import size_multiple
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.model import Model, WeightsError
from yolov5_lifecycle.models.network import Network

SEGMENT_N = dataclasses.replace(
    SIZES["n"],
    layers=(*SIZES["n"].layers[:-1], SIZES["n"].layers[-1]._replace(kind="Segment", args=(32, 256))),
)


def pixels_for(architecture: Architecture) -> torch.Tensor:
    side = 2 * size_multiple(architecture)
    return torch.rand(1, architecture.image_channels, side, side, generator=torch.Generator().manual_seed(0))


def outputs(network: Network, pixels: torch.Tensor) -> list[torch.Tensor]:
    """Predictions, and prototypes of masks if there are any."""
    with torch.inference_mode():
        features = network.eval().features(pixels)
        found = [network.predictions(features)]
        return [*found, network.head.proto(features[0])] if isinstance(network.head, Segment) else found


def assert_same(model: Model, network: Network, *, tolerance: float = 1e-4) -> None:
    pixels = pixels_for(network.architecture)
    for found, expected in zip(outputs(model.network(), pixels), outputs(network, pixels), strict=True):
        torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.long
@pytest.mark.parametrize(
    ("architecture", "options"),
    [
        pytest.param(SMALL, {"era": "v6.0", "opset": 12}, id="v6.0"),
        pytest.param(SMALL, {"era": "v7.0", "opset": 11}, id="v7.0, opset 11"),
        pytest.param(SMALL, {"era": "v7.0", "opset": 13}, id="v7.0, opset 13"),
        pytest.param(SMALL, {"era": "v7.0", "opset": 17}, id="v7.0, opset 17"),
        pytest.param(SMALL, {"era": "raw with boxes"}, id="with raw outputs"),
        pytest.param(SMALL, {"is_dynamic": True, "opset": 11}, id="dynamic, opset 11"),
        pytest.param(SMALL, {"is_dynamic": True, "opset": 17}, id="dynamic, opset 17"),
        pytest.param(SMALL_FAMILIES["segmentation"], {}, id="segmentation"),
        pytest.param(SMALL_FAMILIES["segmentation"], {"is_dynamic": True}, id="dynamic segmentation"),
        pytest.param(SMALL_FAMILIES["cross-stage"], {"era": "v6.0"}, id="as before v4"),
    ],
)
def test_an_export_predicts_what_its_network_predicts(
    architecture: Architecture, options: dict[str, Any]
) -> None:
    network = random_network(0, architecture)
    model = read_onnx(exported(network, **options))
    assert model.class_names == ("class 0", "class 1", "class 2")
    assert_same(model, network)


@pytest.mark.long
@pytest.mark.parametrize(
    ("activation", "opset"),
    [("Hardswish", 12), ("Hardswish", 14), ("LeakyReLU(0.1)", 12), ("ReLU", 12), ("Identity", 12)],
)
def test_activations_are_those_of_the_graph(activation: str, opset: int) -> None:
    architecture = dataclasses.replace(
        SMALL, activation=activation, other_activations=(("model.1.act", "SiLU"),)
    )
    network = random_network(0, architecture)
    model = read_onnx(exported(network, opset=opset))
    assert model.architecture.activation == activation
    assert dict(model.architecture.other_activations) == {"model.1.act": "SiLU"}
    assert_same(model, network)


@pytest.mark.long
def test_an_export_in_half_precision_has_the_rounded_weights() -> None:
    network = random_network(0, SMALL)
    model = read_onnx(exported(network, is_half=True))
    assert model.state_dict["model.0.conv.weight"].dtype is torch.float32
    assert_same(model, network, tolerance=2e-2)


@pytest.mark.long  # a model of full size is exported and read
@pytest.mark.parametrize(
    ("architecture", "options"),
    [
        pytest.param(SIZES["n"], {"era": "v6.0"}, id="v6 n"),
        pytest.param(SIZES["n"], {}, id="v7 n"),
        pytest.param(SIZES["n6"], {}, id="v7 n6"),
        pytest.param(SEGMENT_N, {}, id="v7 n-seg"),
    ],
)
def test_an_export_of_an_official_model_is_that_of_its_pt(
    architecture: Architecture, options: dict[str, Any]
) -> None:
    network = random_network(0, architecture)
    names = [f"class {index}" for index in range(80)]
    kind = "SegmentationModel" if architecture.mask_coefficients else "DetectionModel"
    pickled = official_model(architecture, names, kind=f"models.yolo.{kind}", half=False, network=network)
    expected = read_checkpoint(saved(stripped(pickled)))
    model = read_onnx(exported(random_network(0, architecture), **options))
    assert model.architecture == dataclasses.replace(expected.architecture, is_fused=True)
    assert model.class_names == expected.class_names
    assert_same(model, expected.network())


@pytest.mark.long
@pytest.mark.parametrize("architecture", [SMALL, SEGMENT_N], ids=["own", "official"])
def test_layers_have_the_multiples_of_an_official_size_or_none(architecture: Architecture) -> None:
    read = read_onnx(valid(architecture)).architecture
    expected = (0.33, 0.25, 8) if architecture is SEGMENT_N else (1, 1, 1)
    assert (read.depth_multiple, read.width_multiple, read.channel_multiple) == expected


def test_an_export_without_metadata_has_numbered_classes() -> None:
    model = read_onnx(exported(random_network(0, SMALL), has_metadata=False))
    assert model.class_names == ("class 0", "class 1", "class 2")


@pytest.mark.parametrize(
    ("entry", "names"),
    [
        pytest.param("['a', 'b', 'c']", ("a", "b", "c"), id="list"),
        pytest.param("{2: 'c', 0: 'a', 1: 'b'}", ("a", "b", "c"), id="dict"),
        pytest.param("{0: \"it's\", 1: 'say \"x\"', 2: 'a, b'}", ("it's", 'say "x"', "a, b"), id="quotes"),
        pytest.param(r"['a\\b', '\'\"', '\xe9']", ("a\\b", "'\"", "é"), id="escapes"),
        pytest.param("['Fußgänger', '自転車', 'c',]", ("Fußgänger", "自転車", "c"), id="other scripts"),
    ],
)
def test_class_names_are_those_of_the_metadata(entry: str, names: tuple[str, ...]) -> None:
    data = hostile_onnx.changed(hostile_onnx.set_metadata(names=entry))()
    assert read_onnx(data).class_names == names


@pytest.mark.parametrize(
    "entry",
    [
        *("", "[", "a, b, c", "['a' 'b', 'c']", "['a', 'b', c]", "[['a'], 'b', 'c']", "{'a': 'b'}"),
        *("['a\\N{DIGIT ONE}', 'b', 'c']", "['\\Uffffffff', 'b', 'c']"),
    ],
)
def test_class_names_in_another_form_are_refused(entry: str) -> None:
    data = hostile_onnx.changed(hostile_onnx.set_metadata(names=entry))()
    with pytest.raises(WeightsError, match="class names"):
        read_onnx(data)


def weights_as_constants(model: Any) -> None:
    """As after a simplification: constants are arrays of the graph, and nodes have no names."""
    kept = []
    for node in model.graph.node:
        node.name = ""
        if node.op_type == "Constant":
            array = model.graph.initializer.add()
            array.CopyFrom(node.attribute[0].t)
            array.name = node.output[0]
        else:
            kept.append(node)
    del model.graph.node[:]
    model.graph.node.extend(kept)


def weights_renamed(model: Any) -> None:
    """As torch does it where it changes weights: the names of the nodes are left."""
    for number, array in enumerate(model.graph.initializer):
        for node in model.graph.node:
            node.input[:] = [f"onnx::Conv_{number}" if name == array.name else name for name in node.input]
        array.name = f"onnx::Conv_{number}"
    for node in model.graph.node:
        if node.op_type == "Conv" and node.name.startswith("/m."):  # the head is a module of its own there
            node.name = f"/model.{len(SMALL.layers) - 1}{node.name}"


@pytest.mark.parametrize("change", [weights_as_constants, weights_renamed])
def test_an_export_that_was_rewritten_without_a_change_is_read(change: Callable[[Any], None]) -> None:
    assert_same(read_onnx(hostile_onnx.changed(change)()), random_network(0, SMALL))


@pytest.mark.long
@pytest.mark.parametrize("family", ["ghost", "transformer", "convolutions", "resized"])
def test_layers_that_are_not_read_are_refused_with_a_remedy(family: str) -> None:
    with pytest.raises(WeightsError, match=r"exports of such a (layer|model) are not read; use the \.pt"):
        read_onnx(valid(EVERY_SMALL[family], opset=14))


def test_an_export_is_taken_wherever_weights_are(tmp_path: Path) -> None:
    path = tmp_path / "best.ONNX"
    path.write_bytes(valid())
    assert load_weights(path).model.class_names == ("class 0", "class 1", "class 2")
    converted = convert(path, tmp_path / "best.safetensors", overwrite=False)
    assert_same(converted.model, random_network(0, SMALL))


def changes_of(model: Any) -> list[Callable[[Any], None]]:
    """For each node of `model` changes of its operator, its inputs and its settings."""
    found: list[Callable[[Any], None]] = []
    for place, node in enumerate(model.graph.node):
        found.extend(partial(set_operator, place, operator) for operator in ("Relu", "Mul", "Add"))
        if len(node.input) > 1:
            found.append(partial(reverse_inputs, place))
        found.extend(
            partial(change, place, index)
            for index, attribute in enumerate(node.attribute)
            for kinds, change in (((2, 7), add_one), ((4,), double))
            if attribute.type in kinds
        )
    return found


def set_operator(place: int, operator: str, model: Any) -> None:
    model.graph.node[place].op_type = operator


def reverse_inputs(place: int, model: Any) -> None:
    model.graph.node[place].input.reverse()


def add_one(place: int, index: int, model: Any) -> None:
    attribute = model.graph.node[place].attribute[index]
    if attribute.ints:
        attribute.ints[0] += 1
    else:
        attribute.i += 1


def double(place: int, index: int, model: Any) -> None:
    array = model.graph.node[place].attribute[index].t
    array.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(array) * 2, array.name))


def computed(data: bytes, pixels: torch.Tensor) -> list[NDArray[np.float32]] | None:
    """What ONNX Runtime computes with the graph; None if it cannot."""
    try:
        session = InferenceSession(data, providers=["CPUExecutionProvider"])
        found: list[NDArray[np.float32]] = session.run(None, {session.get_inputs()[0].name: pixels.numpy()})
    except Exception:  # noqa: BLE001 - of any kind: its graph is invalid
        return None
    return found


def assert_refused_or_read_as_computed(architecture: Architecture, changes: slice) -> int:
    """Compare what is read out of changed graphs with what they compute; the number of those accepted."""
    original, accepted = valid(architecture), 0
    pixels = pixels_for(architecture)
    for change in changes_of(model_of(original))[changes]:
        model = model_of(original)
        change(model)
        try:
            read = read_onnx(serialized(model))
        except WeightsError:
            continue
        accepted += 1
        expected = computed(serialized(model), pixels)
        if expected is not None:
            for found, wanted in zip(outputs(read.network(), pixels), expected, strict=True):
                np.testing.assert_allclose(found.numpy(), wanted, rtol=1e-3, atol=1e-3)
    return accepted


@pytest.mark.long
def test_a_graph_with_another_operation_is_refused_or_read_as_it_computes() -> None:
    assert_refused_or_read_as_computed(SMALL, slice(None, None, 9))


@pytest.mark.long
@pytest.mark.parametrize("family", ["cross-stage", "segmentation"])
def test_graphs_of_other_layers_with_another_operation_are_refused_or_read_as_they_compute(
    family: str,
) -> None:
    assert_refused_or_read_as_computed(SMALL_FAMILIES[family], slice(None, None, 5))
