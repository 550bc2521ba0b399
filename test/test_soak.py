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
from soak.images import (
    rejected_costly_files,
    rejected_files,
    rejected_images,
    survived_files,
    survived_messages,
)
from soak.largest_images import bounded_decoding
from soak.mixed_life import mixed_life
from soak.service_requests import answered_requests
from soak.several_cameras import several_cameras
from soak.slow_steps import survived_slow_steps
from soak.subject import Subject, exceptions_in, subject
from soak.track_ids import TrackIds
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota
from yolov5_lifecycle.streaming.frame_statistics import Outcome

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


@pytest.mark.long
@pytest.mark.parametrize(
    "trial",
    [
        pytest.param(lambda process: answered_requests(process, [SEED], 200), id="requests"),
        pytest.param(lambda process: rejected_images(process, IMAGES, SEED), id="images"),
        pytest.param(lambda process: rejected_files(process, IMAGES, SEED), id="files"),
        pytest.param(lambda process: rejected_costly_files(process, IMAGES, SEED), id="costly-files"),
        pytest.param(lambda process: bounded_decoding(process, 512, is_timed=False), id="largest-files"),
        pytest.param(lambda process: survived_files(process, IMAGES, SEED), id="damaged-files"),
        pytest.param(lambda process: survived_messages(process, IMAGES, SEED), id="damaged-messages"),
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


@pytest.mark.long
@pytest.mark.parametrize(
    "trial",
    [
        pytest.param(
            lambda: clean_endings([(signal.SIGTERM, "activating")], SEED, limit_s=END_S), id="signals"
        ),
        pytest.param(lambda: clean_restarts(["active"], SEED), id="kill"),
        pytest.param(lambda: survived_slow_steps(["masks"], side_px=2001, is_timed=False), id="slow-steps"),
        pytest.param(
            lambda: collected_on_bad_disks(2, SEED, ["a second process", "disk full"]), id="collecting"
        ),
    ],
)
def test_a_claim_holds_over_processes(trial: Callable[[], Finding]) -> None:
    finding = trial()
    assert finding.is_met, finding


@pytest.mark.long
def test_everything_at_random_leaves_a_node_that_detects() -> None:
    with subject() as process:
        finding = mixed_life(process, SEED, minutes=0)
        assert finding.is_met, finding
        balance = exact_balance([process.balance])
        assert balance.is_met, balance


@pytest.mark.long
def test_cameras_that_misbehave_at_random_disturb_neither_the_others_nor_the_process() -> None:
    with subject() as process:
        finding = several_cameras(process, SEED, minutes=0, is_judged=False)
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


def told(detected: int) -> dict[str, str]:
    """The counts of a camera."""
    others = dict.fromkeys((f"frames {end.value}" for end in Outcome), "0")
    counts = {"frames received": str(detected), "frames detected": str(detected), "frames pending": "0"}
    return others | counts


def test_counts_that_become_smaller_are_noticed() -> None:
    node = {"": {"state": "active"}}
    watch = BalanceWatch()
    for cameras in ({"front": told(3)}, {"front": told(1)}, {"front": told(2), "rear": told(5)}):
        watch.take(node | cameras)
    assert (watch.problems, watch.received) == (["the counts of 'front' became smaller"], 10)


@pytest.mark.parametrize(
    ("camera", "stamp_ns", "ids", "problem"),
    [
        pytest.param("front", 30, ["1", "2"], "", id="the same tracks"),
        pytest.param("front", 30, ["3", "", ""], "", id="a new track"),
        pytest.param("rear", 30, ["1"], "track 1 of front used for rear", id="of another camera"),
        pytest.param("front", 30, ["4", "4"], "twice", id="twice in an image"),
        pytest.param("front", 90, ["1"], "from before its tracker restarted", id="of the previous tracker"),
        pytest.param("front", 90, ["5"], "", id="a new track of the next tracker"),
        pytest.param("front", 55, ["1"], "", id="while the tracker is replaced"),
    ],
)
def test_a_track_id_that_is_used_twice_is_noticed(
    camera: str, stamp_ns: int, ids: list[str], problem: str
) -> None:
    track_ids = TrackIds()
    track_ids.take("front", 10, ["1", "2", ""])
    if stamp_ns > 50:
        track_ids.restart(["front"], 50, 60)
    track_ids.take(camera, stamp_ns, ids)
    assert [problem in found for found in track_ids.problems] == [True] * bool(problem)


@pytest.mark.parametrize(
    ("damage", "is_wrong"),
    [
        pytest.param("", False, id="nothing"),
        pytest.param("truncate -s 300 images/*/000001.jpg", True, id="half an image"),
        pytest.param("rm labels/*/000001.txt", True, id="no labels"),
        pytest.param("touch labels/$(ls labels)/.x.part", True, id="an unfinished file"),
        pytest.param("truncate -s 0 frames.jsonl", True, id="images without lines"),
        pytest.param("truncate -s 1100K frames.jsonl", True, id="beyond the quota"),
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


@pytest.mark.parametrize(
    ("line", "is_told"),
    [
        pytest.param("Traceback (most recent call last):", True, id="traceback"),
        pytest.param("[ERROR] [yolov5]: unexpected KeyError in on_activate: 'x'", True, id="transition"),
        pytest.param("[ERROR] [yolov5]: unexpected ValueError in a callback: x", True, id="callback"),
        pytest.param("[ERROR] [yolov5]: activate refused: no such file", False, id="refusal"),
        pytest.param("", False, id="nothing"),
    ],
)
def test_an_unexpected_exception_in_the_log_is_noticed(line: str, is_told: bool) -> None:
    assert bool(exceptions_in(f"[INFO] [yolov5]: unconfigured\n{line}\n")) is is_told


def test_a_trial_that_breaks_off_has_failed_with_the_reason() -> None:
    def broken() -> Finding:
        raise ValueError("no ground under it\nmore")

    finding = found("bridge", broken)
    assert not finding.is_met
    assert "bridge" in table([finding])
    assert "ValueError: no ground under it" in table([finding])
