"""What the benchmark of precisions measures, and which ratio it compares with its goal."""

from __future__ import annotations

import pytest
from support.random_model import random_model

from benchmark.masks import measured_ms
from benchmark.precisions import INT8, calls, goal
from yolov5_lifecycle.runtimes.processor_abilities import abilities, has_bf16
from yolov5_lifecycle.runtimes.registry import installed_runtimes

pytestmark = pytest.mark.long

needs_openvino = pytest.mark.skipif(
    "openvino" not in installed_runtimes(), reason="no openvino: make install"
)


@needs_openvino
def test_every_precision_of_the_processor_is_measured() -> None:
    taken_ms = measured_ms(calls(random_model(), (64, 96)), turns=2)
    expected = {f"fp32 in {name}" for name in installed_runtimes() if name != "torch"} | {INT8}
    assert taken_ms.keys() == expected | ({"bf16 in openvino"} if has_bf16(abilities()) else set())
    assert all(len(times_ms) == 2 for times_ms in taken_ms.values())


def test_int8_is_compared_with_the_fastest_fp32() -> None:
    reached = goal("n", {"fp32 in openvino": [18.0], "fp32 in onnxruntime": [15.0], INT8: [10.0]})
    assert (reached.value, reached.is_reached) == (1.5, True)
    assert not goal("n", {"fp32 in openvino": [14.0], INT8: [10.0]}).is_reached
