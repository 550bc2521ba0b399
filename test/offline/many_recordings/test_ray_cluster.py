"""Many recordings on a Ray cluster: the same results, even if a worker or the command is killed."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from support.detected_offline import SET_MODEL, run
from support.many_recordings import LONG, broken, messages, record_drives, states
from support.recorded_scene import COUNT, video
from support.started import started

from yolov5_lifecycle.atomic_file import has_unfinished_outputs
from yolov5_lifecycle.offline.detect_bag import EXIT_INCOMPLETE
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.ros.child_process import entry_point

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(bool(absence_of("ray")), reason=absence_of("ray") or "ray is installed"),
]
_POLL_S = 0.02
_END_S = 30.0


@dataclass(frozen=True)
class RayHead:
    """A running cluster, and the environment in which it answers."""

    address: str
    environment: Mapping[str, str]
    session: int

    def processes(self, title: str) -> list[int]:
        """The processes of the cluster whose title begins with `title`."""
        found = []
        for file in Path("/proc").glob("[0-9]*/cmdline"):
            with suppress(OSError):  # it has ended
                process = int(file.parent.name)
                if file.read_bytes().startswith(title.encode()) and os.getsid(process) == self.session:
                    found.append(process)
        return found


@pytest.fixture(scope="module")
def head() -> Iterator[RayHead]:
    """A new cluster with its own folder and token, without dashboard; all its processes are ended."""
    environment = os.environ | {
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
    }
    folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))  # sockets in it have short paths only
    words = [
        *(str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", "--port=0"),
        *("--num-cpus=2", f"--temp-dir={folder}", "--include-dashboard=false"),
        *("--object-store-memory=100000000", "--disable-usage-stats"),
    ]
    with (folder / "log").open("w") as log:
        head = subprocess.Popen(words, env=environment, stdout=log, stderr=log, start_new_session=True)
        try:
            yield RayHead(_address(head, folder), environment, head.pid)
        finally:
            head.terminate()
            try:
                head.wait(_END_S)
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(head.pid, signal.SIGKILL)
                shutil.rmtree(folder, ignore_errors=True)


def _address(head: subprocess.Popen[bytes], folder: Path) -> str:
    file = folder / "ray_current_cluster"
    while not (file.is_file() and file.read_text().strip()):
        _wait_a_moment(head)
    return file.read_text().strip()


def _wait_a_moment(process: subprocess.Popen[Any]) -> None:
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(_POLL_S)


def detecting(head: RayHead, drives: Path, output: Path) -> AbstractContextManager[subprocess.Popen[str]]:
    words = [entry_point("detect_bag"), drives, "--output", output, "--ray", head.address, *SET_MODEL]
    return started(words, env=head.environment, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, told = process.communicate(timeout=240)
    return process.returncode, told


def wait_for_output(process: subprocess.Popen[str], output: Path) -> None:
    """Wait until a worker writes."""
    while not (output.exists() and has_unfinished_outputs(output)):
        _wait_a_moment(process)


def test_a_cluster_gives_the_results_of_single_runs_and_then_skips_them(
    head: RayHead, tmp_path: Path
) -> None:
    drives = record_drives(tmp_path / "drives", {"a": COUNT, "b": COUNT})
    broken(drives, "c")
    video(drives / "film.avi")
    output = tmp_path / "found"
    with detecting(head, drives, output) as process:
        code, told = ended(process)
    assert code == EXIT_INCOMPLETE, told
    assert states(output) == {"a": "done", "b": "done", "c": "failed", "film": "done"}
    lines = tmp_path / "film.jsonl"
    assert run([str(drives / "film.avi"), "--output", str(lines), *SET_MODEL]) == 0
    assert (output / "film" / "detections.jsonl").read_text() == lines.read_text()
    assert run([str(drives / "a"), "--output", str(tmp_path / "a"), *SET_MODEL]) == 0
    assert messages(output / "a") == messages(tmp_path / "a")
    with detecting(head, drives, output) as process:
        code, told = ended(process)
    assert code == EXIT_INCOMPLETE, told
    assert states(output) == {"a": "skipped", "b": "skipped", "c": "failed", "film": "skipped"}


def test_a_killed_actor_loses_nothing(head: RayHead, tmp_path: Path) -> None:
    drives = record_drives(tmp_path / "drives", {"long": 10 * LONG, "short": COUNT})
    output = tmp_path / "found"
    with detecting(head, drives, output) as process:
        wait_for_output(process, output)
        while not (actors := head.processes("ray::Work.detect")):
            _wait_a_moment(process)
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
    with detecting(head, drives, output) as process:
        wait_for_output(process, output)
        process.send_signal(number)
        code, told = ended(process)
    assert code == 128 + number, told
    assert not output.exists()
