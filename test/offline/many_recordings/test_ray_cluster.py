"""Many recordings on a Ray cluster: the same results, even if a worker or the command is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.detected_offline import SET_MODEL, run
from support.many_recordings import LONG, broken, messages, record_drives
from support.ray_head import RayHead, ray_head
from support.recorded_scene import COUNT, video

from yolov5_lifecycle.atomic_file import has_unfinished_outputs
from yolov5_lifecycle.offline.detect_bag import EXIT_INCOMPLETE
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.ros.child_process import entry_point

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(bool(absence_of("ray")), reason=absence_of("ray") or "ray is installed"),
]
_POLL_S = 0.02


@pytest.fixture(scope="module")
def head() -> Iterator[RayHead]:
    with ray_head(processors=2) as head:
        yield head


def started(head: RayHead, drives: Path, output: Path) -> subprocess.Popen[str]:
    words = [entry_point("detect_bag"), str(drives), "--output", str(output), "--ray", head.address]
    return subprocess.Popen(
        [*words, *SET_MODEL], env=dict(head.environment), stderr=subprocess.PIPE, text=True
    )


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, told = process.communicate(timeout=240)
    return process.returncode, told


def wait_for_output(process: subprocess.Popen[str], output: Path) -> None:
    """Wait until a worker writes."""
    while not (output.exists() and has_unfinished_outputs(output)):
        assert process.poll() is None, process.communicate()[1]
        time.sleep(_POLL_S)


def states(output: Path) -> dict[str, str]:
    rows = json.loads((output / "summary.json").read_text())["results"]
    return {row["recording"]: row["state"] for row in rows}


def test_a_cluster_gives_the_results_of_single_runs_and_then_skips_them(
    head: RayHead, tmp_path: Path
) -> None:
    drives = record_drives(tmp_path / "drives", {"a": COUNT, "b": COUNT})
    broken(drives, "c")
    video(drives / "film.avi")
    output = tmp_path / "found"
    code, told = ended(started(head, drives, output))
    assert code == EXIT_INCOMPLETE, told
    assert states(output) == {"a": "done", "b": "done", "c": "set aside", "film": "done"}
    lines = tmp_path / "film.jsonl"
    assert run([str(drives / "film.avi"), "--output", str(lines), *SET_MODEL]) == 0
    assert (output / "film" / "detections.jsonl").read_text() == lines.read_text()
    assert run([str(drives / "a"), "--output", str(tmp_path / "a"), *SET_MODEL]) == 0
    assert messages(output / "a") == messages(tmp_path / "a")
    code, told = ended(started(head, drives, output))
    assert code == EXIT_INCOMPLETE, told
    assert states(output) == {"a": "skipped", "b": "skipped", "c": "set aside", "film": "skipped"}


def test_a_killed_actor_loses_nothing(head: RayHead, tmp_path: Path) -> None:
    drives = record_drives(tmp_path / "drives", {"long": 10 * LONG, "short": COUNT})
    output = tmp_path / "found"
    process = started(head, drives, output)
    wait_for_output(process, output)
    while not (actors := head.processes("ray::Work.detect")):
        time.sleep(_POLL_S)
    for actor in actors:
        os.kill(actor, signal.SIGKILL)
    code, told = ended(process)
    assert code == 0, told
    assert "another worker retries it" in told
    assert states(output) == {"long": "done", "short": "done"}
    found = [topic for topic, _, _ in messages(output / "long")]
    assert found.count("/yolov5/detections") == 10 * LONG
    assert not has_unfinished_outputs(output)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_actors_and_removes_what_is_unfinished(
    number: signal.Signals, head: RayHead, tmp_path: Path
) -> None:
    drives = record_drives(tmp_path / "drives", {"a": 20 * LONG, "b": 20 * LONG})
    output = tmp_path / "found"
    process = started(head, drives, output)
    wait_for_output(process, output)
    process.send_signal(number)
    code, told = ended(process)
    assert code == 128 + number, told
    assert not output.exists()
