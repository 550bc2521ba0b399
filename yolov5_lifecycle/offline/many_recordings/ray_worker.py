"""Workers as actors of an existing Ray cluster, whose machines have the recordings under the same paths."""

from __future__ import annotations

import logging
import signal
import socket
from typing import Any

import ray

from yolov5_lifecycle.offline.many_recordings.recording_task import OnImage
from yolov5_lifecycle.offline.many_recordings.workers import Work, Worker
from yolov5_lifecycle.printable import in_one_line

_ANSWER_S = 10.0


def connected(address: str) -> int:
    """Connect to the cluster at `address` and return the number of its processors; raises ConnectionError."""
    handler = signal.getsignal(signal.SIGTERM)
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if port.isdecimal():  # Ray would wait forever for an address where nothing listens
            socket.create_connection((host.strip("[]"), int(port)), _ANSWER_S).close()
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
        signal.signal(signal.SIGTERM, handler)  # Ray's would end this process with code 15
    except Exception as error:  # it raises whatever its parts raise
        raise ConnectionError(
            f"--ray {address}: no Ray cluster answers ({error}). `ray start --head` starts one on this "
            "machine, `ray status` shows whether it runs."
        ) from error
    processors = int(ray.cluster_resources().get("CPU", 0))
    if not processors:
        ray.shutdown()
        raise ConnectionError(f"--ray {address}: the cluster has no CPUs; start a Ray node that has some.")
    return processors


class RayWorker(Worker):
    """An actor of the connected cluster, with one processor."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        # Ray itself sets OMP_NUM_THREADS to the number of processors.
        self._actor = ray.remote(num_cpus=1)(Work).remote()

    def stop(self) -> None:
        ray.kill(self._actor)

    def close(self) -> None:
        """Ray does not say when it has ended."""

    def _answer(self, method: str, argument: object, on_image: OnImage) -> Any:
        try:
            return ray.get(getattr(self._actor, method).remote(argument))
        except ray.exceptions.RayError as error:
            told = in_one_line(str(error).strip().partition("\n")[0]) or type(error).__name__
            raise ChildProcessError(f"the worker died ({told})") from None
