"""Handlers for termination signals."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

TERMINATION_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""SIGHUP is sent when a terminal or an ssh connection is closed."""


def on_termination(handle: Callable[[int], object]) -> None:
    """Call `handle` with the number of each termination signal from now on.

    SIGHUP stays ignored if it was, as under nohup.
    """
    for number in TERMINATION_SIGNALS:
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, _: handle(number))


def end_at_once(code: int | None = None) -> None:
    """On any of the signals, exit immediately with `code`, or with 128 plus the signal number."""
    on_termination(lambda number: os._exit(128 + number if code is None else code))
