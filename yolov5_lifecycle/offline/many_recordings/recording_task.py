"""Detection in one recording after the other with one model, and the worker process that does it."""

from __future__ import annotations

import errno
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

from yolov5_lifecycle.atomic_file import OutputError, whole_output
from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.offline.detecting import DetectingError, OfflineDetector, RunStatistics, prepared_for
from yolov5_lifecycle.offline.export.exporting import write_files
from yolov5_lifecycle.offline.export.formats import JSON_LINES
from yolov5_lifecycle.offline.many_recordings.results import (
    RECORD_NAME,
    Plan,
    RecordingResult,
    failed,
    finished_before,
    origin,
)
from yolov5_lifecycle.offline.recordings import SourceRecording, is_video
from yolov5_lifecycle.printable import in_lines, in_one_line
from yolov5_lifecycle.process.standard_streams import complain
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError
from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)

OnImage = Callable[[int], object]
"""Called after every image with the number of images of the recording so far."""


class RecordingTask:
    """Owns the model of `plan`, loaded by `prepare`, and detects in recordings.

    Raises ValueError, OSError and InferenceError if the model cannot be loaded with the settings.
    """

    def __init__(self, plan: Plan, on_image: OnImage, *, prepare: Prepare = prepare_model) -> None:
        self._on_image = on_image
        self._first_problem = ""
        self._prepared = prepared_for(plan.settings, prepare)
        runtime = self._prepared.detector.runtime
        self.plan = plan.chosen(runtime.name, runtime.precision)
        self._detector()  # what is missing for these settings is told now, once

    def run(self, source: SourceRecording) -> RecordingResult | DetectingError:
        """Write the result of `source`, unless it exists; return its row, with the reason if that failed.

        Where every other recording would fail, too, returns an error for lack of room, or raises
        DeviceLostError.
        """
        begun_s = time.monotonic()
        self._first_problem = ""
        try:
            return self._result(source, begun_s)
        except Exception as error:  # noqa: BLE001 - one recording must not end the others
            if isinstance(error.__cause__, DeviceLostError):
                raise error.__cause__ from None
            if getattr(error, "errno", None) in _NO_ROOM:
                return DetectingError(in_lines(f"{self.plan.output}: {error}"))
            return failed(
                source,
                in_lines(str(error) or type(error).__name__),
                first_problem=self._first_problem,
                seconds=time.monotonic() - begun_s,
            )

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        self._first_problem = self._first_problem or in_one_line(f"{label}: {outcome.value}: {error}")

    def progress(self, statistics: RunStatistics) -> None:
        self._on_image(statistics.outcomes.total())

    def _result(self, source: SourceRecording, begun_s: float) -> RecordingResult:
        if (finished := finished_before(source, self.plan)) is not None:
            return finished  # perhaps by a worker that was then killed
        target, made_from = self.plan.output / source.name, origin(source.path, self.plan)
        if os.path.lexists(target):
            raise OutputError(
                f"{target} exists and is not replaced, as it was made from other weights, settings or files: "
                "remove it, or choose another --output."
            )
        with whole_output(target) as unfinished:
            statistics = self._detect(source.path, unfinished)
            result = RecordingResult(
                recording=source.name,
                path=str(source.path),
                state="done",
                first_problem=self._first_problem,
                seconds=round(time.monotonic() - begun_s, 3),
                runtime=self.plan.settings.runtime,
                detections={name: statistics.objects[name] for name in self._prepared.detector.class_names},
                made_from=made_from,
                **statistics.counts,
            )
            (unfinished / RECORD_NAME).write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
            if origin(source.path, self.plan) != made_from:
                raise SourceError(f"{source.path}: it changed while it was read. Is it still being recorded?")
        return result

    def _detect(self, source: Path, unfinished: Path) -> RunStatistics:
        export = self.plan.export
        suffix = export.suffix or (JSON_LINES if is_video(source) else "")
        if suffix:
            unfinished.mkdir()
        path = unfinished / f"detections{suffix}" if suffix else unfinished
        crops = unfinished / export.crops if export.crops else None
        export = replace(export, path=path, suffix=suffix, crops=crops)
        if is_video(source):
            return write_files(source, export, self._detector)
        # Imported here: videos do not need rosbags.
        from yolov5_lifecycle.offline.detect_recording import write_recording

        return write_recording(source, export, self._detector)

    def _detector(self) -> OfflineDetector:
        """A detector with the same model and a tracker of its own."""
        return OfflineDetector(
            self.plan.settings, self._prepared, self, with_masks=self.plan.export.needs_masks
        )


def main(descriptor: int) -> NoReturn:
    """Work for the other end of the socket with this `descriptor`, until that is closed."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    os.set_inheritable(descriptor, False)
    try:
        _serve(Connection(descriptor))
    except (EOFError, ConnectionError):
        pass  # nobody waits for the results any more
    except Exception as error:  # noqa: BLE001 - whatever it is, the process ends
        complain("detect_bag", f"a worker ends: {type(error).__name__}: {error}")
    finally:
        os._exit(1)  # freeing a model takes longer than ending


def _serve(connection: Connection[Any, Any]) -> None:
    """Answer a plan with what was chosen for it, and then each recording with its result."""
    plan = connection.recv()
    try:
        task = RecordingTask(plan, connection.send)
    except (ValueError, OSError, ImportError, InferenceError) as error:
        connection.send(DetectingError(in_lines(str(error) or type(error).__name__)))
        return
    connection.send(task.plan)
    while True:
        connection.send(task.run(connection.recv()))
