"""What must be settled in a node's process before the node's modules are imported."""

from __future__ import annotations

import os
import signal

from yolov5_lifecycle.heap import prepare_heap


def prepare_process() -> None:
    """End with code 0 at SIGINT and SIGTERM from now on; make the heap one for images.

    The imports to come take seconds, in which Python would answer with a traceback or die of the signal. They
    also begin threads.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    prepare_heap()
