"""An examination: a group of checks in a process of its own, which may crash or hang."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from yolov5_lifecycle.doctor.examined import PROGRAM
from yolov5_lifecycle.doctor.finding import Finding, Line, error
from yolov5_lifecycle.printable import in_one_line

_MAX_ANSWER_BYTES = 1 << 20
_LAST_WORDS_BYTES = 1 << 13
_LAST_LINES = 4
_POLL_S = 0.1
_DEATH_S = 2.0
"""A process inside a hanging driver does not even die of SIGKILL."""


@dataclass(frozen=True)
class Examination:
    """The checks of `module`, for `target` if there is one.

    `suspect`: what to do if they hang or crash.
    """

    name: str
    module: str
    patience_s: float
    suspect: str
    target: str = ""

    def __str__(self) -> str:
        return f"{self.name} {self.target}".strip()


def examine(examination: Examination, *, root: Path, patience_s: float) -> list[Line]:
    """What the checks found within `patience_s`; then their process and its children are killed."""
    command = [sys.executable, "-c", PROGRAM]
    command += [examination.module, str(root), examination.target, sys.argv[0]]
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        answer, last_words = _heard(process, process.stdout, process.stderr, patience_s)
        code = process.poll()
    finally:
        _kill(process)
    lines, under_way = _lines(answer)
    if code != 0:
        text = f"no answer within {patience_s:.0f} s" if code is None else f"it ended with {_reason(code)}"
        found = f"{text}. {_shortened(last_words)}".removesuffix(". ")
        lines.append(Line(under_way or str(examination), error(found, remedy=examination.suspect)))
    return lines


def _heard(
    process: subprocess.Popen[bytes], stdout: IO[bytes], stderr: IO[bytes], patience_s: float
) -> tuple[bytes, bytes]:
    """The beginning of stdout and the end of stderr, until the process ends or the time is over."""
    end_s = time.monotonic() + patience_s
    answer, last_words = bytearray(), bytearray()
    with selectors.DefaultSelector() as selector:
        selector.register(stdout, selectors.EVENT_READ, answer)
        selector.register(stderr, selectors.EVENT_READ, last_words)
        while selector.get_map() and (left_s := end_s - time.monotonic()) > 0:
            has_ended = process.poll() is not None  # asked before reading: all it wrote is there
            ready = selector.select(0 if has_ended else min(left_s, _POLL_S))
            if has_ended and not ready:  # a process that it started has the pipe still open
                break
            for key, _ in ready:
                if chunk := os.read(key.fd, 1 << 16):
                    key.data.extend(chunk)
                else:
                    selector.unregister(key.fileobj)
            del last_words[:-_LAST_WORDS_BYTES]
            del answer[_MAX_ANSWER_BYTES:]
        with suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, end_s - time.monotonic()))
    return bytes(answer), bytes(last_words)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill the process with all that it started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    with suppress(subprocess.TimeoutExpired):
        process.wait(_DEATH_S)
    for stream in (process.stdout, process.stderr):
        if stream is not None:
            stream.close()


def _lines(answer: bytes) -> tuple[list[Line], str]:
    """The findings of the complete lines, and the subject of the last check that began."""
    lines, subject = [], ""
    for text in answer.decode(errors="replace").split("\n")[:-1]:
        fields = json.loads(text)
        if "subject" in fields:
            subject = fields["subject"]
        else:
            lines.append(Line(subject, Finding(**fields)))
    return lines, subject


def _reason(code: int) -> str:
    return signal.strsignal(-code) or f"signal {-code}" if code < 0 else f"exit code {code}"


def _shortened(last_words: bytes) -> str:
    lines = [line for line in last_words.decode(errors="replace").splitlines() if line.strip()]
    return in_one_line(" | ".join(lines[-_LAST_LINES:]), 400)
