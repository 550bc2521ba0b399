"""What the benchmark of families measures, and when it says that one is slow."""

from __future__ import annotations

import pytest

from benchmark.families import EAGER, QUICK, families, goal, heading, line
from benchmark.report import row

pytestmark = pytest.mark.long


def test_the_families_that_are_measured_differ_from_each_other() -> None:
    found = dict(families())
    assert set(QUICK) <= found.keys()
    assert len(set(found.values())) == len(found) > 25


def test_a_family_is_slow_when_no_runtime_is_as_fast_as_eager_torch() -> None:
    rows = [row("v3.0/yolov5s", name, 0, [ms]) for name, ms in ((EAGER, 10.0), ("runtime torch", 12.0))]
    assert not goal(rows).is_reached
    faster = [*rows, row("v3.0/yolov5s", "runtime openvino", 0, [5.0])]
    assert goal(faster).value == 0.5
    assert heading(faster).split()[2:6] == ["eager", "torch", "torch", "openvino"]
    assert line(faster).split() == ["v3.0/yolov5s", "10.0", "12.0", "5.0", "0.50"]
