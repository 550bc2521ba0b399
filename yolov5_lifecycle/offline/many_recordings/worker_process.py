"""A worker as a process: reads a plan and recordings as lines of JSON from a socket, and answers in JSON."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NoReturn

from yolov5_lifecycle.process.environment import prepare_environment

_PROGRESS_PERIOD_S = 0.2
_EXIT_DEVICE_LOST = 3

Send = Callable[[dict[str, object]], None]


def main(descriptor: int) -> NoReturn:
    """Serve the socket with this `descriptor` until its other end is closed."""
    prepare_environment()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    os.set_inheritable(descriptor, False)
    code = 1
    try:
        with socket.socket(fileno=descriptor) as connection:
            code = _served(connection)
    except BrokenPipeError:  # nobody waits for the results any more
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        sys.stderr.flush()
        os._exit(code)  # freeing a model takes longer than ending


def _served(connection: socket.socket) -> int:
    """The exit code."""
    from yolov5_lifecycle.offline.many_recordings.answers import encoded

    with connection.makefile("r", encoding="utf-8") as requests:

        def send(answer: dict[str, object]) -> None:
            connection.sendall(encoded(answer).encode() + b"\n")

        return _answered(requests, send)


def _answered(requests: Iterable[str], send: Send) -> int:
    # Imported here: they import numpy and torch, for which the environment must be prepared.
    from yolov5_lifecycle.offline.many_recordings.answers import refusal
    from yolov5_lifecycle.offline.many_recordings.plan import Plan
    from yolov5_lifecycle.offline.many_recordings.recording_task import NoRoomError, RecordingTask
    from yolov5_lifecycle.offline.recordings import SourceRecording
    from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError

    lines = iter(requests)
    try:
        task = RecordingTask(Plan.model_validate_json(next(lines)), _Pulse(send))
    except (ValueError, OSError, ImportError, InferenceError) as error:
        send(refusal(error))
        return 0
    send({"ready": [task.runtime, task.precision]})
    for line in lines:
        request = json.loads(line)
        try:
            result = task.run(SourceRecording(request["name"], Path(request["path"])))
        except NoRoomError as error:
            send(refusal(error))
            return 0
        except DeviceLostError:
            return _EXIT_DEVICE_LOST
        send({"ended": result.model_dump()})
    return 0


class _Pulse:
    """Sends the number of images now and then."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._due_s = 0.0

    def __call__(self, images: int) -> None:
        now_s = time.monotonic()
        if now_s >= self._due_s or images == 1:
            self._due_s = now_s + _PROGRESS_PERIOD_S
            self._send({"progress": images})
