"""Command `detector`: what must be settled before the node's modules are imported."""

from __future__ import annotations

import os
import signal
from typing import NoReturn

from yolov5_lifecycle.heap import prepare_heap


def main() -> NoReturn:
    """End with code 0 at SIGINT and SIGTERM from now on, then import the node and run it.

    The imports take seconds, in which Python would answer with a traceback or die of the signal. They also
    begin threads.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    prepare_heap()

    from yolov5_lifecycle.ros import detector

    detector.main()
