"""A Ray cluster of this machine alone, for the time of a test."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

_START_S = 90.0
_END_S = 30.0


@dataclass(frozen=True)
class RayHead:
    """A running cluster, and the environment in which it answers."""

    address: str
    environment: Mapping[str, str]
    session: int

    def processes(self, title: str) -> list[int]:
        """The processes of the cluster whose title begins with `title`."""
        return [
            process
            for process in (int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdecimal())
            if _title(process).startswith(title) and _session(process) == self.session
        ]


@contextmanager
def ray_head(processors: int) -> Iterator[RayHead]:
    """A new cluster with its own folder and token, without dashboard; all its processes are ended."""
    environment = os.environ | {
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
    }
    folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))  # sockets in it have short paths only
    words = [
        *(str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", "--port=0"),
        *(f"--num-cpus={processors}", f"--temp-dir={folder}", "--include-dashboard=false"),
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
    file, deadline_s = folder / "ray_current_cluster", time.monotonic() + _START_S
    while not (file.is_file() and file.read_text().strip()):
        assert head.poll() is None, (folder / "log").read_text()
        assert time.monotonic() < deadline_s, (folder / "log").read_text()
        time.sleep(0.1)
    return file.read_text().strip()


def _title(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:  # it has ended
        return ""


def _session(process: int) -> int:
    try:
        return os.getsid(process)
    except ProcessLookupError:
        return 0
