"""Every runtime predicts what YOLOv5's own implementation predicts, of every size and every family."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray
from support.checkpoint_builder import assert_same
from support.formula_model import (
    EVERY_FAMILY,
    EVERY_SIZE,
    expected_predictions,
    families,
    family_architecture,
    family_checkpoint,
    formula_model,
    formula_pixels,
    modules_digest,
    state_dict_digest,
)
from support.runtime_names import COMPILED_RUNTIMES

from yolov5_lifecycle.checkpoints.archive import read_archive
from yolov5_lifecycle.checkpoints.pickle_interpreter import unpickled
from yolov5_lifecycle.checkpoints.pickled_model import model_root
from yolov5_lifecycle.checkpoints.pickled_objects import modules_of
from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors, write_safetensors
from yolov5_lifecycle.models.architecture import SIZES
from yolov5_lifecycle.models.network import Network, fuse
from yolov5_lifecycle.runtimes.compiled_runtime import DetectionHead, Threads
from yolov5_lifecycle.runtimes.networks_by_shape import denormals_as_zero
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph
from yolov5_lifecycle.runtimes.registry import imported_engine
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime


@pytest.mark.parametrize("size", EVERY_SIZE)
def test_a_size_predicts_what_the_official_one_predicts_fused_or_not_and_in_torch(size: str) -> None:
    expected, model = expected_predictions(size), formula_model(size)
    pixels = formula_pixels(expected.input_shape)
    network = model.network().eval()
    with torch.inference_mode():
        expected.check(network(pixels)[0].numpy())
        expected.check(fuse(network)(pixels)[0].numpy())
    runtime = TorchRuntime.load(formula_model(size), device="cpu", precision="fp32")
    # The pixels are no multiples of 1/255; torch also takes fractions of a grey level.
    frame = 255 * pixels[0].permute(1, 2, 0).contiguous().numpy()
    expected.check(runtime(cast("NDArray[np.uint8]", frame), "rgb").rows)


@pytest.mark.long
@pytest.mark.parametrize("name", EVERY_FAMILY)
def test_a_file_predicts_what_the_official_network_predicts_fused_or_not_and_converted(
    name: str, tmp_path: Path
) -> None:
    data, told = family_checkpoint(name), families()[name]
    modules = modules_of(model_root(unpickled(read_archive(data))))
    assert state_dict_digest(modules) == told["state_dict_sha256"], "the file is not official"
    assert modules_digest(modules) == told["modules_sha256"], "the file is not official"
    model = read_checkpoint(data)
    assert model.architecture == family_architecture(name)

    network, expected = model.network().eval(), expected_predictions(name)
    pixels = formula_pixels(expected.input_shape)
    with torch.inference_mode():
        expected.check(network(pixels)[0].numpy())
        expected.check(fuse(network)(pixels)[0].numpy())

    write_safetensors(model, tmp_path / "converted.safetensors")
    again = read_safetensors((tmp_path / "converted.safetensors").read_bytes())
    assert_same(again, model)


@pytest.mark.long
@pytest.mark.parametrize("name", [*SIZES, *EVERY_FAMILY])
@pytest.mark.parametrize("runtime_name", COMPILED_RUNTIMES)
def test_a_compiled_network_predicts_what_the_official_one_predicts(runtime_name: str, name: str) -> None:
    expected = expected_predictions(name)
    pixels = formula_pixels(expected.input_shape).numpy()
    expected.check(compiled_predictions(formula_model(name).network().eval(), runtime_name, pixels))


def compiled_predictions(
    network: Network, runtime_name: str, pixels: NDArray[np.float32]
) -> NDArray[np.float32]:
    """All predictions (N, 5 + C) for `pixels` (1, 3, h, w) in [0, 1], with the parts of `CompiledRuntime`."""
    fuse(network)
    height, width = pixels.shape[2:]
    with denormals_as_zero():  # the engines leave the calling thread in that mode, which is ended here
        graph = graph_of_pixels(network, (height, width))
        loaded = imported_engine(runtime_name, "fp32").load(graph, Threads(each=1))
        return DetectionHead(network.head)(loaded()(pixels), 0.0)


def graph_of_pixels(network: Network, size_hw: tuple[int, int]) -> bytes:
    """The graph of `onnx_graph` without the conversion of its input: it takes float32 pixels in [0, 1]."""
    model = onnx.load_from_string(onnx_graph(network, size_hw))
    graph = model.graph
    as_float, scaled = graph.node[:2]
    assert (as_float.op_type, scaled.op_type) == ("Cast", "Mul")
    graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.FLOAT
    for node in graph.node:
        node.input[:] = [graph.input[0].name if name == scaled.output[0] else name for name in node.input]
    del graph.node[:2]
    content: bytes = model.SerializeToString()
    return content
