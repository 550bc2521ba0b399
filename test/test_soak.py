"""A short soak: the trials of `make soak` with small numbers; no figure of time or memory decides."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from support.candidates import keep

from soak.balance import BalanceWatch, exact_balance
from soak.collecting import collected_on_bad_disks, wrong_in
from soak.console_requests import refused_strangers
from soak.cycles import complete_cycles
from soak.endings import clean_endings, clean_restarts
from soak.faults import survived_faults
from soak.finding import Finding, found, table
from soak.images import rejected, survived
from soak.largest_images import bounded_decoding
from soak.mixed_life import mixed_life
from soak.service_requests import answered_requests
from soak.subject import Subject, exceptions_in, subject
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota
from yolov5_lifecycle.streaming.frame_statistics import Outcome

pytestmark = pytest.mark.long

IMAGES = 50
END_S = 60.0
"""How long the end of a process is waited for."""
SEED = 1


@pytest.fixture(scope="module")
def shared_subject() -> Iterator[Subject]:
    with subject() as shared:
        yield shared
        shared.status()  # one balance at least
        assert exact_balance([shared.balance]).is_met


@pytest.mark.parametrize(
    "trial",
    [
        pytest.param(lambda process: answered_requests(process, [SEED], 200), id="requests"),
        pytest.param(lambda process: rejected("raw", process, IMAGES, SEED), id="images"),
        pytest.param(lambda process: rejected("compressed", process, IMAGES, SEED), id="files"),
        pytest.param(lambda process: bounded_decoding(process, 512, is_timed=False), id="largest-files"),
        pytest.param(lambda process: survived("compressed", process, IMAGES, SEED), id="damaged-files"),
        pytest.param(lambda process: survived("raw", process, IMAGES, SEED), id="damaged-messages"),
        pytest.param(lambda process: refused_strangers(process, 300, SEED), id="console"),
        pytest.param(lambda process: complete_cycles(process, 4, 4, weigh=False), id="cycles"),
        pytest.param(lambda process: survived_faults(process, 1, is_timed=False), id="faults"),
    ],
)
def test_a_claim_holds_in_a_running_process(
    trial: Callable[[Subject], Finding], shared_subject: Subject
) -> None:
    finding = trial(shared_subject)
    assert finding.is_met, finding


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


def test_everything_at_random_leaves_a_node_that_detects() -> None:
    with subject() as process:
        finding = mixed_life(process, SEED, minutes=0)
        assert finding.is_met, finding
        balance = exact_balance([process.balance])
        assert balance.is_met, balance


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


def test_counts_that_become_smaller_are_noticed() -> None:
    def told(detected: int) -> dict[str, str]:
        others = dict.fromkeys((f"frames {end.value}" for end in Outcome), "0")
        counts = {"frames received": str(detected), "frames detected": str(detected), "frames pending": "0"}
        return others | counts

    watch = BalanceWatch()
    for cameras in ({"front": told(3)}, {"front": told(1)}, {"front": told(2), "rear": told(5)}):
        watch.take({"": {"state": "active"}, **cameras})
    assert (watch.problems, watch.received) == (["the counts of 'front' became smaller"], 10)


@pytest.mark.parametrize(
    ("damage", "is_wrong"),
    [
        pytest.param("", False, id="nothing"),
        pytest.param("truncate -s 300 images/*/000001.jpg", True, id="half an image"),
        pytest.param("rm labels/*/000001.txt", True, id="no labels"),
        pytest.param("touch labels/$(ls labels)/.x.part", True, id="an unfinished file"),
        pytest.param("truncate -s 0 frames/*/000001.json", True, id="an image without a record"),
        pytest.param("truncate -s 1100K large", True, id="beyond the quota"),
    ],
)
def test_what_is_wrong_in_a_folder_of_collected_images_is_noticed(
    damage: str, is_wrong: bool, tmp_path: Path
) -> None:
    with closing(
        CollectedFolder(tmp_path, Quota(max_bytes=1 << 20, max_frames=9, min_free_bytes=0))
    ) as folder:
        assert keep(folder)
    subprocess.run(damage, shell=True, check=True, cwd=tmp_path)
    assert bool(wrong_in(tmp_path)) is is_wrong


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
