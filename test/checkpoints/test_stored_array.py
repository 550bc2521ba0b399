"""Arrays of ONNX files, as the onnx package writes them."""

from __future__ import annotations

import numpy as np
import pytest
from onnx import TensorProto, helper

from yolov5_lifecycle.checkpoints.protobuf_fields import ProtobufReader
from yolov5_lifecycle.checkpoints.stored_array import StoredArray, stored_array
from yolov5_lifecycle.models.model import WeightsError

MAX_PACKED = 4096


def read(array: TensorProto) -> StoredArray:
    return stored_array(ProtobufReader(), memoryview(array.SerializeToString()))


@pytest.mark.parametrize("is_raw", [pytest.param(True, id="raw"), pytest.param(False, id="packed")])
@pytest.mark.parametrize(
    ("kind", "dtype", "values"),
    [
        pytest.param(TensorProto.FLOAT, np.float32, [0.5, -2, 3e38], id="float32"),
        pytest.param(TensorProto.DOUBLE, np.float64, [0.1, -2, 1e300], id="float64"),
        pytest.param(TensorProto.INT64, np.int64, [-(2**63), 0, 2**63 - 1], id="int64"),
        pytest.param(TensorProto.INT32, np.int32, [-(2**31), 0, 2**31 - 1], id="int32"),
        pytest.param(TensorProto.INT8, np.int8, [-128, 0, 127], id="int8"),
        pytest.param(TensorProto.UINT8, np.uint8, [0, 1, 255], id="uint8"),
        pytest.param(TensorProto.BOOL, np.bool_, [False, True, True], id="bool"),
    ],
)
def test_numbers_are_read_as_onnx_stores_them(
    kind: int, dtype: type[np.generic], values: list[float], is_raw: bool
) -> None:
    stored = np.array(values, dtype)
    content = stored.tobytes() if is_raw else values
    found = read(helper.make_tensor("grid", kind, [3, 1], content, raw=is_raw)).numbers()
    assert found.dtype == stored.dtype
    np.testing.assert_array_equal(found, stored[:, None])


@pytest.mark.parametrize(
    ("kind", "number", "dtype"),
    [
        pytest.param(TensorProto.INT8, 128, "i1", id="above int8"),
        pytest.param(TensorProto.INT8, -129, "i1", id="below int8"),
        pytest.param(TensorProto.UINT8, -1, "u1", id="below uint8"),
        pytest.param(TensorProto.BOOL, 2, "b1", id="no bool"),
    ],
)
def test_an_integer_outside_of_its_type_is_refused(kind: int, number: int, dtype: str) -> None:
    array = TensorProto(name="grid", data_type=kind, dims=[1], int32_data=[number])
    with pytest.raises(WeightsError, match=rf"integers that are no \|{dtype}"):
        read(array)


def test_only_small_arrays_may_be_packed() -> None:
    largest = helper.make_tensor("grid", TensorProto.FLOAT, [MAX_PACKED], np.ones(MAX_PACKED, np.float32))
    assert read(largest).numbers().sum() == MAX_PACKED
    larger = helper.make_tensor("grid", TensorProto.FLOAT, [MAX_PACKED + 1], np.ones(MAX_PACKED + 1))
    with pytest.raises(
        WeightsError, match=f"{MAX_PACKED + 1} numbers that are not raw, at most {MAX_PACKED}"
    ):
        read(larger)
