"""Cameras as the page shows them, from diagnostics."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message

from yolov5_lifecycle.ros.console.camera_view import StatusView, read_statuses


def status_with(key: str, value: str) -> StatusView:
    status = DiagnosticStatus(name="yolov5: front", values=[KeyValue(key=key, value=value)])
    ((_, view),) = read_statuses(serialize_message(DiagnosticArray(status=[status])))
    return view


@pytest.mark.parametrize(
    ("key", "value", "balance"),
    [
        pytest.param("frames detected", "12", {"detected": 12}, id="number"),
        pytest.param("frames detected", "9" * 18, {"detected": 10**18 - 1}, id="18 digits"),
        pytest.param("frames detected", "9" * 19, {}, id="19 digits"),
        pytest.param("frames detected", "9" * 5_000, {}, id="more digits than Python converts"),
        pytest.param("frames detected", "-1", {}, id="negative"),
        pytest.param("frames detected", "١٢", {}, id="digits of another script"),
        pytest.param("frames lost", "3", {}, id="sent but not received"),
        pytest.param("rate Hz", "3", {}, id="no number of frames"),
    ],
)
def test_the_balance_has_the_numbers_of_frames(key: str, value: str, balance: dict[str, int]) -> None:
    assert status_with(key, value).balance == balance
