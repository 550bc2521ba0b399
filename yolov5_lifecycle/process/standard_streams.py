"""Output to standard streams, which may be closed, full or broken."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from yolov5_lifecycle.printable import in_lines, in_one_line, in_report, without_secrets

EXIT_NOT_WRITTEN = 1
"""Exit code if stdout could not be written, for example to a full disk."""
EXIT_NOBODY_READS = 141
"""Exit code if the reader of stdout closed it, as `| head` does; equals a shell's code for SIGPIPE."""

_LINE = 78
"""Letters of a progress line: fewer than the usual 80, so that it is not broken, and padded to overwrite."""
_DRAIN_S = 1.0
_STREAMS = ("stdin", "stdout", "stderr")


def open_standard_streams() -> None:
    """Open closed standard streams (`>&-`) on the null device; call before anything else is opened.

    Otherwise the next socket or file would get the descriptor of stdout, and with it the log.
    """
    for number, name in enumerate(_STREAMS):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free descriptor, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115


def write_output(command: str, text: str) -> int:
    """Write the lines of `text` to stdout; returns 0, or the exit code for output that cannot be written.

    Replaces unprintable characters, see `in_report`, and escapes those that the output encoding lacks. No-op
    without stdout.
    """
    if sys.stdout is None:
        return 0
    encoding = sys.stdout.encoding or "utf-8"
    return _guarded(command, 0, in_report(text).encode(encoding, "backslashreplace").decode(encoding))


def flush_output(command: str, code: int) -> int:
    """Flush stdout; returns `code`, or the exit code for an output that could not be written.

    Reports the error to stderr, unless the reader closed the pipe. Afterwards Python has nothing left to
    flush, so it reports no error on exit.
    """
    return _guarded(command, code, "")


def _guarded(command: str, code: int, text: str) -> int:
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        code = EXIT_NOBODY_READS
    except OSError as error:
        complain(command, f"the output cannot be written: {error.strerror}")
        code = EXIT_NOT_WRITTEN
    else:
        return code
    _discard_output()
    return code


def complain(command: str, problem: object) -> None:
    """Write `problem`, which may contain untrusted text, to stderr if possible."""
    _show(in_lines(f"{command}: {problem}") + "\n")


def show_report(text: str) -> None:
    """Write the lines of `text` to stderr if possible, see `in_report`."""
    _show(in_report(text))


def show_progress(text: str, *, done: bool = False) -> None:
    """Overwrite the previous progress line with `text`, which may contain untrusted text; `done` ends it.

    Without text the line stays as it is. No-op if stderr is no terminal.
    """
    if sys.stderr.isatty():
        line = f"\r{in_one_line(text, _LINE):<{_LINE}}" if text else ""
        _show(line + ("\n" if done else ""))


def _show(text: str) -> None:
    with suppress(OSError):
        sys.stderr.write(text)
        sys.stderr.flush()


@contextmanager
def stderr_without_secrets() -> Iterator[None]:
    """What C libraries write to stderr meanwhile is passed on line by line, see `without_secrets`.

    One at a time in a process; what other threads write is passed on, too.
    """
    reader, writer = os.pipe()
    stderr = os.dup(2)
    os.dup2(writer, 2)
    os.close(writer)
    passing = threading.Thread(target=_pass_on, args=(reader, stderr), daemon=True)
    passing.start()
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        passing.join(_DRAIN_S)


def _pass_on(reader: int, stderr: int) -> None:
    with open(reader, "rb") as lines, open(stderr, "wb", buffering=0) as out:
        for line in lines:  # to the end, even if nobody reads stderr: its writers must not wait
            with suppress(OSError):
                shown = without_secrets(os.fsdecode(line.rstrip(b"\n")))
                out.write(os.fsencode(f"{shown}\n"))


def _discard_output() -> None:
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)
    sys.stdout.flush()
