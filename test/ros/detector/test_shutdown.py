"""A signal and the transition `shutdown` end the installed detector's process."""

from __future__ import annotations

import signal

import pytest
from support.detector_process import (
    PARAMETERS,
    as_arguments,
    detector_process,
)

from yolov5_lifecycle.ros.detector.command import FINALIZED_S
from yolov5_lifecycle.ros.observer import PATIENCE_S


@pytest.mark.end_to_end
@pytest.mark.parametrize(
    ("state", "signal_number"),
    [
        pytest.param("unconfigured", signal.SIGTERM, id="unconfigured-SIGTERM"),
        pytest.param("active", signal.SIGINT, id="active-SIGINT"),
        pytest.param("unconfigured", signal.SIGINT, id="unconfigured-SIGINT", marks=pytest.mark.long),
        pytest.param("inactive", signal.SIGINT, id="inactive-SIGINT", marks=pytest.mark.long),
        pytest.param("inactive", signal.SIGTERM, id="inactive-SIGTERM", marks=pytest.mark.long),
        pytest.param("active", signal.SIGTERM, id="active-SIGTERM", marks=pytest.mark.long),
    ],
)
def test_a_signal_ends_the_process_cleanly(state: str, signal_number: signal.Signals) -> None:
    with detector_process(*as_arguments(PARAMETERS)) as detector:
        detector.bring_to(state)
        if state == "active":
            detector.look()
        assert detector.process.stop(signal_number) == 0
    assert "Traceback" not in detector.process.output


@pytest.mark.long
def test_the_transition_shutdown_is_answered_and_ends_the_process_cleanly() -> None:
    with detector_process(*as_arguments(PARAMETERS)) as detector:
        detector.bring_to("active")
        assert detector.transition("shutdown")
        assert detector.process.wait(PATIENCE_S) == 0
    assert "Traceback" not in detector.process.output


def test_nav2_has_the_time_to_ask() -> None:
    assert FINALIZED_S >= 2 * 2.0, "its manager waits 2 s for the answer of get_state"
