"""Command `detector`: what a signal does before the node is there to be released."""

from __future__ import annotations

import os
import signal
from typing import NoReturn


def main() -> NoReturn:
    """End with code 0 at SIGINT and SIGTERM from now on, then import the node and run it.

    The imports take seconds, in which Python would answer with a traceback or die of the signal.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))

    from yolov5_lifecycle.ros import detector

    detector.main()
