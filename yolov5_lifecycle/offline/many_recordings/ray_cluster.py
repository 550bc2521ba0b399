"""Workers as actors of an existing Ray cluster, whose machines have the recordings under the same paths."""

from __future__ import annotations

import itertools
import logging
import signal
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.missing_package import absence_of

if TYPE_CHECKING:
    from yolov5_lifecycle.offline.many_recordings.plan import Plan
    from yolov5_lifecycle.offline.many_recordings.recording_task import RecordingTask
    from yolov5_lifecycle.offline.many_recordings.workers import Event
    from yolov5_lifecycle.offline.recordings import SourceRecording

_ANSWER_S = 10.0
_END_S = 10.0
_PAUSE_S = 0.1


class ClusterError(ConnectionError):
    """A cluster that cannot be used; the message has the remedy."""


def ray_workers(address: str, jobs: int | None, recordings: int) -> RayWorkers:
    """Connect to the cluster at `address`; raises ClusterError.

    There are `jobs` workers, but no more than the cluster has processors (the default) and no more than
    `recordings`. Each has one processor.
    """
    if absence := absence_of("ray"):
        raise ClusterError(f"--ray needs the package ray: {absence}")
    import ray

    handler = signal.getsignal(signal.SIGTERM)
    try:
        _check_answer(address)
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
        signal.signal(signal.SIGTERM, handler)  # Ray's would end this process with code 15
    except Exception as error:  # it raises whatever its parts raise
        raise ClusterError(
            f"--ray {address}: no Ray cluster answers ({error}). `ray start --head` starts one on this "
            "machine, `ray status` shows whether it runs."
        ) from error
    processors = int(ray.cluster_resources().get("CPU", 0))
    if not processors:
        ray.shutdown()
        raise ClusterError(f"--ray {address}: the cluster has no CPUs; start a Ray node that has some.")
    return RayWorkers(max(1, min(jobs or processors, processors, recordings)))


def _check_answer(address: str) -> None:
    """Raise OSError unless something listens at `address`: Ray would wait for it forever."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), _ANSWER_S).close()


class Actor:
    """Runs in a process of the cluster; answers in JSON, see `Answer`."""

    def __init__(self, plan: str) -> None:
        prepare_environment()
        self._plan = plan
        self._task: RecordingTask | None = None

    def load(self) -> str:
        """Load the model."""
        # Imported here: they import torch, for which the environment must be prepared.
        from yolov5_lifecycle.offline.many_recordings.answers import encoded, refusal
        from yolov5_lifecycle.offline.many_recordings.plan import Plan
        from yolov5_lifecycle.offline.many_recordings.recording_task import RecordingTask
        from yolov5_lifecycle.runtimes.runtime import InferenceError

        try:
            self._task = RecordingTask(Plan.model_validate_json(self._plan), lambda _: None)
        except (ValueError, OSError, ImportError, InferenceError) as error:
            return encoded(refusal(error))
        return encoded({"ready": [self._task.runtime, self._task.precision]})

    def detect(self, name: str, path: str) -> str:
        """Detect in a recording."""
        from yolov5_lifecycle.offline.many_recordings.answers import encoded, refusal
        from yolov5_lifecycle.offline.many_recordings.recording_task import NoRoomError
        from yolov5_lifecycle.offline.recordings import SourceRecording

        assert self._task is not None
        try:
            return encoded({"ended": self._task.run(SourceRecording(name, Path(path))).model_dump()})
        except NoRoomError as error:
            return encoded(refusal(error))


class RayWorkers:
    """Up to `max_count` actors of the cluster that this process is connected to. See `Workers`."""

    def __init__(self, max_count: int) -> None:
        self.max_count = max_count
        self._numbers = itertools.count()
        self._actors: dict[int, Any] = {}
        self._pending: dict[Any, tuple[int, str | None]] = {}
        self._output: Path | None = None

    def start(self, plan: Plan) -> int:
        import ray

        number = next(self._numbers)
        # Ray itself sets OMP_NUM_THREADS to the number of processors.
        actor = ray.remote(num_cpus=1, max_restarts=0)(Actor).remote(plan.model_dump_json())
        self._actors[number] = actor
        self._pending[actor.load.remote()] = (number, None)
        self._output = plan.output
        return number

    def begin(self, worker: int, source: SourceRecording) -> None:
        call = self._actors[worker].detect.remote(source.name, str(source.path))
        self._pending[call] = (worker, source.name)

    def events(self, timeout_s: float) -> list[Event]:
        import ray

        calls, _ = ray.wait(list(self._pending), num_returns=1, timeout=timeout_s)
        return [self._event(call) for call in calls]

    def close(self) -> None:
        import ray

        for actor in self._actors.values():
            ray.kill(actor)
        self._actors.clear()
        if self._output is not None:
            _remove_unfinished(self._output)
        ray.shutdown()

    def _event(self, call: Any) -> Event:
        import ray

        from yolov5_lifecycle.offline.many_recordings.answers import AnswerError, read_answer
        from yolov5_lifecycle.offline.many_recordings.workers import Died, Ended, Ready, Refused
        from yolov5_lifecycle.printable import in_one_line

        number, recording = self._pending.pop(call)
        expected = frozenset({"ready" if recording is None else "ended", "refused"})
        try:
            answer = read_answer(str(ray.get(call)), expected=expected, recording=recording)
        except AnswerError as error:
            ray.kill(self._actors.pop(number))
            return Died(number, str(error))
        except ray.exceptions.RayError as error:
            ray.kill(self._actors.pop(number))
            reason = str(error).strip().splitlines()
            told = in_one_line(reason[0]) if reason else type(error).__name__
            return Died(number, f"the worker died ({told})")
        if answer.ready is not None:
            return Ready(number, *answer.ready)
        if answer.ended is not None:
            return Ended(number, answer.ended)
        ray.kill(self._actors.pop(number))
        return Refused(number, answer.refused or "")


def _remove_unfinished(folder: Path) -> None:
    """Remove what killed actors leave behind, once they are dead."""
    from yolov5_lifecycle.atomic_file import has_unfinished_outputs, remove_unfinished_outputs

    deadline_s = time.monotonic() + _END_S
    while has_unfinished_outputs(folder) and time.monotonic() < deadline_s:
        remove_unfinished_outputs(folder)
        time.sleep(_PAUSE_S)
