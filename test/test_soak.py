"""A short soak: the trials of `make soak` with small numbers; no figure of time or memory decides."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

from soak.cycles import complete_cycles
from soak.endings import clean_endings, clean_restarts
from soak.finding import Finding, table
from soak.mixed_life import mixed_life
from soak.subject import exact_balance, subject

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
