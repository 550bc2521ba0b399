"""Child process that ends with its context manager or its parent; a ROS domain for such processes."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

_DYING_WITH_ITS_PARENT = ("setpriv", "--pdeathsig", "TERM") if shutil.which("setpriv") else ()
"""Of util-linux, which Debian and Ubuntu always have."""
_KEPT_LINES = 5000
_KILL_S = 5.0
_END_S = 60.0
"""Timeout for the end of a process after a signal, possibly on a slow machine."""


class ChildProcess:
    """Runs `command` and records its output; as a context manager, ends the process on exit.

    Start it in a thread that lives as long as the process should: when the thread ends, be it because its
    process is killed, the command gets SIGTERM.
    """

    def __init__(self, name: str, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self.name = name
        self._heard = threading.Condition()
        self._lines: deque[str] = deque(maxlen=_KEPT_LINES)
        self._is_silent = False
        self._process = subprocess.Popen(
            [*_DYING_WITH_ITS_PARENT, *command],
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        )
        self._reader = threading.Thread(target=self._read, name=f"output of {name}", daemon=True)
        self._reader.start()

    def __enter__(self) -> ChildProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()  # a killed one would leave its shared memory
        try:
            self._process.wait(_KILL_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(_KILL_S)

    @property
    def output(self) -> str:
        """The process's stdout and stderr so far."""
        with self._heard:
            return "".join(self._lines)

    @property
    def process_id(self) -> int:
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """None while the process runs."""
        return self._process.poll()

    def check_running(self) -> None:
        """Raise RuntimeError if the process has ended."""
        code = self.exit_code
        if code is not None:
            self._reader.join(_KILL_S)
            raise RuntimeError(
                f"the {self.name} ended with exit code {code}. Its last output:\n{self.last_words}"
            )

    def wait_for_output(self, text: str, timeout_s: float) -> None:
        """Wait until `text` is in the output; raises RuntimeError on timeout or if the process ends."""
        with self._heard:
            self._heard.wait_for(lambda: self._is_silent or text in "".join(self._lines), timeout_s)
        if text not in self.output:
            raise RuntimeError(f"the {self.name} did not print '{text}'. Its last output:\n{self.last_words}")

    def wait(self, timeout_s: float) -> int:
        """Wait for the process to end and return its exit code; raises RuntimeError on timeout."""
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise RuntimeError(
                f"the {self.name} did not end within {timeout_s:g} s. Its last output:\n{self.last_words}"
            ) from None
        self._reader.join(_KILL_S)
        return code

    def stop(self, signal_number: int = signal.SIGINT, *, timeout_s: float = _END_S) -> int:
        """Send the signal, wait, and return the exit code; raises RuntimeError on timeout."""
        self._process.send_signal(signal_number)
        return self.wait(timeout_s)

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as stream:
            for line in stream:
                with self._heard:
                    self._lines.append(line)
                    self._heard.notify_all()
        with self._heard:
            self._is_silent = True
            self._heard.notify_all()

    @property
    def last_words(self) -> str:
        """The last lines of the output, indented."""
        return textwrap.indent("\n".join(self.output.splitlines()[-15:]) or "(none)", "  ")


def entry_point(name: str) -> str:
    """Path of the package's executable `name`, next to the running executable or else next to Python.

    Raises FileNotFoundError with the remedy.
    """
    folders = [Path(sys.argv[0]).absolute().parent, Path(sys.executable).absolute().parent]
    for folder in folders:
        if (folder / name).is_file():
            return str(folder / name)
    raise FileNotFoundError(
        f"no executable '{name}' in {' or '.join(map(str, folders))}: install the package (make install)"
    )


DOMAINS: Sequence[int] = range(1, 101)
"""Domain ids whose UDP ports lie below Linux's ephemeral port range."""
_OTHER_REACHES = ("ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS")


@contextmanager
def own_domain(domains: Sequence[int] = DOMAINS) -> Iterator[int]:
    """The first of `domains` (values of ROS_DOMAIN_ID) that no other caller on this machine holds.

    It is held until the end of the block. Raises RuntimeError if all are in use.
    """
    for domain in domains:
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                # An abstract Linux socket address: held by one process, released when the process ends.
                claim.bind(f"\0yolov5_lifecycle/domain/{domain}")
            except OSError:
                continue
            yield domain
            return
    raise RuntimeError(f"all {len(domains)} ROS domains for tests and demos are in use on this machine")


def isolated(environment: Mapping[str, str], domain: int) -> dict[str, str]:
    """`environment` for a process restricted to `domain` on this machine."""
    # ROS_LOCALHOST_ONLY, the older variable, would override the discovery range.
    kept = {name: value for name, value in environment.items() if name not in _OTHER_REACHES}
    return kept | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
