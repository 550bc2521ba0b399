"""Property: however a weights file is damaged, it is refused, or gives a model of the same shape."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import hostile_archives, hostile_onnx, hostile_safetensors
from support.onnx_exports import small_export

from fuzz.targets import check_onnx, check_weights
from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors

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
