"""Property: however a weights file is damaged, it is refused, or gives a model of the same shape."""

from __future__ import annotations

import copy
import functools
import itertools
import json
import pickletools
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import hostile_archives, hostile_onnx, hostile_safetensors
from support.onnx_exports import small_export

from fuzz.targets import check_onnx, check_weights
from yolov5_lifecycle.checkpoints.onnx_file import read_onnx
from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors
from yolov5_lifecycle.models.model import WeightsError

_FEW = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
_PROTOCOLS = (2, 5)
_PLACE = st.floats(0, 1, exclude_max=True)
_SPLICES = st.lists(st.tuples(_PLACE, st.integers(0, 16), st.binary(max_size=16)), min_size=1, max_size=4)
Splices = list[tuple[float, int, bytes]]


def spliced(data: bytes, splices: Splices) -> bytes:
    """`data` with some bytes at some places (parts of its length) replaced by others."""
    for place, removed, added in splices:
        start = int(place * len(data))
        data = data[:start] + added + data[start + removed :]
    return data


@_FEW
@given(_SPLICES)
def test_a_damaged_checkpoint_is_refused_or_whole(splices: Splices) -> None:
    check_weights(read_checkpoint, spliced(hostile_archives.valid(), splices))


@pytest.mark.long
@_FEW
@given(st.sampled_from(_PROTOCOLS), _SPLICES)
def test_a_checkpoint_with_a_damaged_pickle_is_refused_or_whole(protocol: int, splices: Splices) -> None:
    check_weights(
        read_checkpoint,
        hostile_archives.with_pickle(spliced(hostile_archives.valid_pickle(protocol), splices)),
    )


@pytest.mark.long
@_FEW
@given(st.sampled_from(_PROTOCOLS), st.integers(0, 1 << 20), st.integers(0, 255))
def test_a_checkpoint_with_one_other_byte_in_its_pickle_is_refused_or_whole(
    protocol: int, place: int, byte: int
) -> None:
    pickle = bytearray(hostile_archives.valid_pickle(protocol))
    pickle[place % len(pickle)] = byte
    check_weights(read_checkpoint, hostile_archives.with_pickle(bytes(pickle)))


@_FEW
@given(_SPLICES)
def test_a_damaged_safetensors_file_is_refused_or_whole(splices: Splices) -> None:
    check_weights(read_safetensors, spliced(hostile_safetensors.valid(), splices))


@_FEW
@given(st.integers(0, 1 << 20), st.integers(0, 255))
def test_a_safetensors_file_with_one_other_byte_in_its_header_is_refused_or_whole(
    place: int, byte: int
) -> None:
    data = bytearray(hostile_safetensors.valid())
    data[place % (8 + int.from_bytes(data[:8], "little"))] = byte
    check_weights(read_safetensors, bytes(data))


@_FEW
@given(_SPLICES)
def test_a_damaged_export_is_refused_or_whole(splices: Splices) -> None:
    check_onnx(spliced(small_export(), splices))


@_FEW
@given(st.integers(0, 1 << 20), st.integers(0, 255))
def test_an_export_with_one_other_byte_in_its_graph_is_refused_or_whole(place: int, byte: int) -> None:
    graph = bytearray(hostile_onnx.graph_without_weights())
    graph[place % len(graph)] = byte
    check_onnx(hostile_onnx.glued(bytes(graph)))


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
@_FEW
@given(st.sampled_from(["architecture", "class_names"]), st.lists(st.integers(0, 99), max_size=5), JSON)
def test_a_safetensors_file_that_describes_anything_is_refused_or_whole(
    entry: str, places: list[int], value: object
) -> None:
    header, tensors = hostile_safetensors.parted(hostile_safetensors.valid())
    described = replaced(json.loads(header["__metadata__"][entry]), places, value)
    header["__metadata__"][entry] = json.dumps(described)
    check_weights(read_safetensors, hostile_safetensors.joined(header, tensors))


@pytest.mark.long
@_FEW
@given(st.lists(st.integers(0, 99), max_size=4), JSON)
def test_a_safetensors_file_with_any_header_is_refused_or_whole(places: list[int], value: object) -> None:
    header, tensors = hostile_safetensors.parted(hostile_safetensors.valid())
    check_weights(read_safetensors, hostile_safetensors.joined(replaced(header, places, value), tensors))


@functools.cache
def pickled_operations(protocol: int) -> list[bytes]:
    """The checkpoint's pickle, cut between its operations."""
    pickle = hostile_archives.valid_pickle(protocol)
    starts = [place for *_, place in pickletools.genops(pickle) if place is not None]
    return [pickle[start:end] for start, end in itertools.pairwise([*starts, len(pickle)])]


@pytest.mark.long
@settings(_FEW, max_examples=20)
@given(
    st.sampled_from(_PROTOCOLS),
    st.lists(st.tuples(_PLACE, _PLACE, st.integers(0, 3)), min_size=1, max_size=4),
)
def test_a_checkpoint_with_its_operations_in_another_order_is_refused_or_whole(
    protocol: int, moves: list[tuple[float, float, int]]
) -> None:
    operations = list(pickled_operations(protocol))
    for source, target, removed in moves:
        start = int(target * len(operations))
        operations[start : start + removed] = [operations[int(source * len(operations))]]
    check_weights(read_checkpoint, hostile_archives.with_pickle(b"".join(operations)))


@pytest.mark.parametrize("read", [read_checkpoint, read_safetensors, read_onnx])
@settings(max_examples=40, derandomize=True)
@given(data=st.binary(max_size=64))
def test_random_bytes_are_refused(read: Callable[[bytes], object], data: bytes) -> None:
    with pytest.raises(WeightsError):
        read(data)


@pytest.mark.parametrize("size", range(0, 64, 7))
def test_a_file_cut_after_a_few_bytes_is_refused(size: int) -> None:
    with pytest.raises(WeightsError):
        read_checkpoint(hostile_archives.valid()[:size])
    with pytest.raises(WeightsError):
        read_safetensors(hostile_safetensors.valid()[:size])
    with pytest.raises(WeightsError):
        read_onnx(small_export()[:size])
