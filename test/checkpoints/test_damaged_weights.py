"""Property: however a weights file is damaged, it is refused, or gives a model of the same shape."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import hostile_archives, hostile_onnx, hostile_safetensors
from support.onnx_exports import small_export

from fuzz.targets import check_onnx, check_weights
from yolov5_lifecycle.checkpoints.onnx_file import read_onnx
from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors
from yolov5_lifecycle.models.model import WeightsError

_PLACE = st.floats(0, 1, exclude_max=True)
_SPLICES = st.lists(st.tuples(_PLACE, st.integers(0, 16), st.binary(max_size=16)), min_size=1, max_size=4)
Splices = list[tuple[float, int, bytes]]


def spliced(data: bytes, splices: Splices) -> bytes:
    """`data` with some bytes at some places (parts of its length) replaced by others."""
    for place, removed, added in splices:
        start = int(place * len(data))
        data = data[:start] + added + data[start + removed :]
    return data


def check_pickle(data: bytes) -> None:
    check_weights(read_checkpoint, hostile_archives.with_pickle(data))


def check_header(data: bytes) -> None:
    tensors = hostile_safetensors.cut(hostile_safetensors.valid())[1]
    check_weights(read_safetensors, hostile_safetensors.glued(data, tensors))


@pytest.mark.parametrize(
    ("valid", "check"),
    [
        pytest.param(
            hostile_archives.valid, lambda data: check_weights(read_checkpoint, data), id="checkpoint"
        ),
        pytest.param(lambda: hostile_archives.valid_pickle(5), check_pickle, id="pickle of protocol 5"),
        pytest.param(hostile_archives.valid_pickle, check_pickle, id="pickle", marks=pytest.mark.long),
        pytest.param(
            hostile_safetensors.valid, lambda data: check_weights(read_safetensors, data), id="safetensors"
        ),
        pytest.param(
            lambda: hostile_safetensors.cut(hostile_safetensors.valid())[0], check_header, id="header"
        ),
        pytest.param(small_export, check_onnx, id="export"),
        pytest.param(
            hostile_onnx.graph_without_weights,
            lambda data: check_onnx(hostile_onnx.glued(data)),
            id="graph",
        ),
    ],
)
@settings(max_examples=40)
@given(splices=_SPLICES)
def test_a_damaged_file_is_refused_or_whole(
    valid: Callable[[], bytes], check: Callable[[bytes], None], splices: Splices
) -> None:
    check(spliced(valid(), splices))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda below: st.lists(below, max_size=3) | st.dictionaries(st.text(max_size=4), below, max_size=3),
    max_leaves=4,
)


def replaced(tree: Any, places: list[int], value: Any) -> Any:
    """`tree` with what stands at a place replaced: each number picks a branch, until there is none."""
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree))) if isinstance(tree, list) else []
    if not keys or not places:
        return value
    key = keys[places[0] % len(keys)]
    changed = copy.copy(tree)
    changed[key] = replaced(tree[key], places[1:], value)
    return changed


@pytest.mark.long
@settings(max_examples=40)
@given(st.sampled_from(["", "architecture", "class_names"]), st.lists(st.integers(0, 99), max_size=5), JSON)
def test_a_safetensors_file_that_says_anything_is_refused_or_whole(
    entry: str, places: list[int], value: object
) -> None:
    """In its header, or in an entry of its metadata."""
    header, tensors = hostile_safetensors.parted(hostile_safetensors.valid())
    if entry:
        described = replaced(json.loads(header["__metadata__"][entry]), places, value)
        header["__metadata__"][entry] = json.dumps(described)
    else:
        header = replaced(header, places, value)
    check_weights(read_safetensors, hostile_safetensors.joined(header, tensors))


@pytest.mark.parametrize("size", range(0, 64, 7))
def test_a_file_cut_after_a_few_bytes_is_refused(size: int) -> None:
    for read, data in (
        (read_checkpoint, hostile_archives.valid()),
        (read_safetensors, hostile_safetensors.valid()),
        (read_onnx, small_export()),
    ):
        with pytest.raises(WeightsError):
            read(data[:size])
