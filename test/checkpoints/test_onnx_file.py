"""Exports to ONNX of both layouts are told apart by their shapes and metadata; others are refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support import hostile_onnx
from support.checkpoint_builder import SMALL
from support.onnx_exports import NAMES, exported, small_export
from support.random_model import random_network

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.checkpoints.onnx_file import export_cost, read_onnx
from yolov5_lifecycle.commands.convert import convert
from yolov5_lifecycle.models.cost import cost_of
from yolov5_lifecycle.models.model import Export, WeightsError

NUMBERED = ("class 0", "class 1", "class 2")


@pytest.mark.parametrize("masks", [0, 4])
@pytest.mark.parametrize("has_objectness", [True, False])
def test_the_layout_is_told_from_shapes_and_names(has_objectness: bool, masks: int) -> None:
    export = read_onnx(small_export(has_objectness=has_objectness, masks=masks))
    assert (export.has_objectness, export.mask_coefficients) == (has_objectness, masks)
    assert (export.boxes, export.prototypes) == (0, 1 if masks else None)
    assert export.class_names == NAMES


@pytest.mark.parametrize("has_objectness", [True, False])
def test_an_export_without_metadata_has_numbered_classes(has_objectness: bool) -> None:
    export = read_onnx(small_export(has_objectness=has_objectness, metadata={}, size_hw=(320, 320)))
    assert (export.class_names, export.has_objectness) == (NUMBERED, has_objectness)


@pytest.mark.parametrize("batch", [None, 1, 2])
@pytest.mark.parametrize("size_hw", [None, (64, 96)])
def test_what_is_fixed_is_told(size_hw: tuple[int, int] | None, batch: int | None) -> None:
    export = read_onnx(small_export(size_hw=size_hw, batch=batch))
    assert (export.size_hw, export.batch) == (size_hw, batch)


def test_an_export_in_half_precision_is_fp16() -> None:
    assert read_onnx(small_export(is_half=True)).precision == "fp16"


@pytest.mark.parametrize(
    ("stride", "size_hw", "expected"),
    [
        pytest.param("32", (64, 96), 32, id="as written"),
        pytest.param("32.0", None, 32, id="as a decimal number"),
        pytest.param(None, (64, 96), 32, id="not told, fixed size"),
        pytest.param(None, None, 64, id="not told, any size: what every model takes"),
    ],
)
def test_images_are_multiples_of_the_stride(
    stride: str | None, size_hw: tuple[int, int] | None, expected: int
) -> None:
    metadata = {"names": str(list(NAMES))} | ({"stride": stride} if stride else {})
    assert read_onnx(small_export(size_hw=size_hw, metadata=metadata)).stride == expected


@pytest.mark.parametrize(
    ("entry", "names"),
    [
        pytest.param("['a', 'b', 'c']", ("a", "b", "c"), id="list"),
        pytest.param("{2: 'c', 0: 'a', 1: 'b'}", ("a", "b", "c"), id="dict"),
        pytest.param("{0: 'a', 2: 'c'}", ("a", "class 1", "c"), id="an index left out"),
        pytest.param("{0: \"it's\", 1: 'say \"x\"', 2: 'a, b'}", ("it's", 'say "x"', "a, b"), id="quotes"),
        pytest.param(r"['a\\b', '\'\"', '\xe9']", ("a\\b", "'\"", "é"), id="escapes"),
        pytest.param("['Fußgänger', '自転車', 'c',]", ("Fußgänger", "自転車", "c"), id="other scripts"),
    ],
)
def test_class_names_are_those_of_the_metadata(entry: str, names: tuple[str, ...]) -> None:
    assert read_onnx(small_export(metadata={"names": entry})).class_names == names


@pytest.mark.parametrize(
    "entry",
    [
        *("", "[", "a, b, c", "['a' 'b', 'c']", "['a', 'b', c]", "[['a'], 'b', 'c']", "{'a': 'b'}"),
        *("['a\\N{DIGIT ONE}', 'b', 'c']", "['\\Uffffffff', 'b', 'c']", "{'a', 'b', 'c'}"),
        *("[__import__('os').system('true')]", "[" * 100_000, f"[{'1,' * 1_000_000}]"),
    ],
    # pytest escapes a backslash once more for each time that it collects in one process, as mutmut makes it.
    ids=lambda entry: entry[:20].replace("\\", "") or "empty",
)
def test_class_names_in_another_form_are_refused(entry: str) -> None:
    with pytest.raises(WeightsError, match="class names"):
        read_onnx(small_export(metadata={"names": entry}))


def weights_as_constants(model: Any) -> None:
    """As without a simplification: arrays are constants of the graph."""
    for array in model.graph.initializer:
        node = model.graph.node.add(op_type="Constant", output=[array.name])
        node.attribute.add(name="value", type=4).t.CopyFrom(array)
        model.graph.node.insert(0, model.graph.node.pop())
    del model.graph.initializer[:]


def weights_as_inputs(model: Any) -> None:
    """As torch did it before 1.5."""
    for array in model.graph.initializer:
        model.graph.input.add(name=array.name)


@pytest.mark.parametrize(
    "change",
    [
        *(weights_as_constants, weights_as_inputs),
        pytest.param(lambda model: setattr(model.opset_import[0], "domain", "ai.onnx"), id="domain"),
        pytest.param(hostile_onnx.add(hostile_onnx.node("Shape", "images")), id="asks for a size"),
    ],
)
def test_an_export_of_another_exporter_is_read(change: Callable[[Any], None]) -> None:
    assert read_onnx(hostile_onnx.changed(change)()).class_names == NAMES


def test_an_export_is_loaded_but_not_converted(tmp_path: Path) -> None:
    path = tmp_path / "best.ONNX"
    path.write_bytes(small_export())
    assert isinstance(load_weights(path).content, Export)
    with pytest.raises(WeightsError, match=r"best\.ONNX: an export to ONNX .* use the \.pt"):
        convert(path, tmp_path / "best.safetensors", overwrite=False)


@pytest.mark.parametrize(("batch", "images"), [(None, 1), (2, 2)], ids=["any batch", "two at once"])
def test_the_cost_is_that_of_the_convolution(batch: int | None, images: int) -> None:
    cost = export_cost(read_onnx(small_export(size_hw=None, batch=batch)), (320, 640))
    assert cost.multiply_adds == pytest.approx(images * 8 * 3 * 320 * 640, rel=0.01)


@pytest.mark.long  # torch exports a network
def test_the_cost_is_that_of_the_network() -> None:
    network = random_network(0, SMALL)
    expected = cost_of(SMALL, (320, 320))
    found = export_cost(read_onnx(exported(network, is_dynamic=True)), (320, 320))
    assert 1 <= found.multiply_adds / expected.multiply_adds < 1.3  # sums and activations count, too
    assert found.weight_bytes == pytest.approx(expected.weight_bytes, rel=0.05)
    assert found.activation_bytes == pytest.approx(expected.activation_bytes, rel=0.5)
