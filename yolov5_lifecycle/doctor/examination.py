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
    """What the checks found within `patience_s`; then their process and its children are killed.

    If a check ends the process, another process makes the checks behind it.
    """
    end_s = time.monotonic() + patience_s
    lines: list[Line] = []
    begun, is_over = 0, False
    while not is_over:
        found, count, is_over = _examined(examination, root, begun, end_s)
        lines += found
        begun += count
        is_over |= count == 0 or time.monotonic() > end_s
    return lines


def _examined(
    examination: Examination, root: Path, skipped: int, end_s: float
) -> tuple[list[Line], int, bool]:
    """What all checks but the first `skipped` found, how many began, and whether the last of them ended."""
    patience_s = max(0.0, end_s - time.monotonic())
    command = [sys.executable, "-c", PROGRAM, examination.module, str(root), examination.target]
    process = subprocess.Popen(
        [*command, str(skipped), sys.argv[0]],
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
    lines, begun, has_ended = _lines(answer)
    if not has_ended:
        found = f"{_reason(code, patience_s)}. {_shortened(last_words)}".removesuffix(". ")
        subject = begun[-1] if begun else str(examination)
        lines.append(Line(subject, error(found, remedy=examination.suspect)))
    return lines, len(begun), has_ended


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


def _lines(answer: bytes) -> tuple[list[Line], list[str], bool]:
    """The findings, the subjects of the checks that began, and whether the last of them ended."""
    lines, begun = list[Line](), list[str]()
    for text in answer.decode(errors="replace").split("\n")[:-1]:
        fields = json.loads(text)
        if not fields:
            return lines, begun, True
        if "subject" in fields:
            begun.append(fields["subject"])
        else:
            lines.append(Line(begun[-1], Finding(**fields)))
    return lines, begun, False


def _reason(code: int | None, patience_s: float) -> str:
    if code is None:
        return f"no answer within {patience_s:.0f} s; what follows in this group was not checked"
    return f"it ended with {signal.strsignal(-code) if code < 0 else f'exit code {code}'}"


def _shortened(last_words: bytes) -> str:
    lines = [line for line in last_words.decode(errors="replace").splitlines() if line.strip()]
    return in_one_line(" | ".join(lines[-_LAST_LINES:]), 400)
