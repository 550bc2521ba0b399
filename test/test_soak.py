"""A short soak: the trials of `make soak` with small numbers; no figure of time or memory decides."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

from soak.balance import BalanceWatch, exact_balance
from soak.collecting import collected_on_bad_disks
from soak.cycles import complete_cycles
from soak.endings import clean_endings, clean_restarts
from soak.finding import Finding, found, table
from soak.mixed_life import mixed_life
from soak.subject import exceptions_in, subject

pytestmark = pytest.mark.long

END_S = 60.0
"""How long the end of a process is waited for."""
SEED = 1


@pytest.mark.parametrize(
    "trial",
    [
        pytest.param(
            lambda: clean_endings([(signal.SIGTERM, "activating")], SEED, limit_s=END_S), id="signals"
        ),
        pytest.param(lambda: clean_restarts(["active"], SEED), id="kill"),
        pytest.param(
            lambda: collected_on_bad_disks(2, SEED, ["a second process", "disk full"]), id="collecting"
        ),
    ],
)
def test_a_claim_holds_over_processes(trial: Callable[[], Finding]) -> None:
    finding = trial()
    assert finding.is_met, finding


def test_after_cycles_and_everything_at_random_a_node_detects() -> None:
    with subject() as process:
        findings = [complete_cycles(process, 4, 4, weigh=False), mixed_life(process, SEED, minutes=0)]
        findings.append(exact_balance([process.balance]))
    assert all(finding.is_met for finding in findings), table(findings)


# The judges themselves


def balances(*counts: tuple[int, int, int], state: str = "active") -> Finding:
    """The finding about messages that tell so many received, detected and pending frames."""
    watch = BalanceWatch()
    others = dict.fromkeys(
        (f"frames {end}" for end in ("stale", "rejected", "failed", "inactive", "skipped", "flushed")), "0"
    )
    for received, detected, pending in counts:
        told = {"frames received": received, "frames detected": detected, "frames pending": pending}
        watch.take({"": {"state": state} | others | {name: str(count) for name, count in told.items()}})
    return exact_balance([watch])


def test_a_frame_in_two_counts_or_in_none_is_noticed() -> None:
    assert balances((3, 2, 1), (5, 4, 1)).is_met
    assert not balances((3, 2, 0)).is_met
    assert not balances((3, 4, -1)).is_met
    assert not balances((4, 1, 3)).is_met
    assert not balances((3, 3, 0), (3, 2, 1)).is_met
    assert not balances((3, 2, 1), state="inactive").is_met
    assert not balances().is_met


def test_an_unexpected_exception_in_the_log_is_noticed() -> None:
    told = [
        "Traceback (most recent call last):",
        "[ERROR] [yolov5]: unexpected KeyError in on_activate: 'x'",
        "[ERROR] [yolov5]: unexpected ValueError in a callback: x",
    ]
    usual = ["[INFO] [yolov5]: unconfigured", "[ERROR] [yolov5]: activate refused: no such file", ""]
    assert exceptions_in("\n".join([*usual, *told])) == told


def test_a_trial_that_breaks_off_has_failed_with_the_reason() -> None:
    def broken() -> Finding:
        raise ValueError("no ground under it\nmore")

    finding = found("bridge", broken)
    assert not finding.is_met
    assert "bridge" in table([finding])
    assert "ValueError: no ground under it" in table([finding])
