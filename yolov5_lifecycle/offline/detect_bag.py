"""Command `detect_bag SOURCE ...`: run the detector on recordings, a video or images, without ROS."""

from __future__ import annotations

import argparse
import functools
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.offline.detect_bag_arguments import TRACK, command_parser
from yolov5_lifecycle.offline.detect_files import detect_files
from yolov5_lifecycle.offline.detecting import DetectingError, OfflineDetector, RunStatistics
from yolov5_lifecycle.offline.detector_options import unwound_by_sigterm, wanted_settings
from yolov5_lifecycle.offline.export.exporting import Export
from yolov5_lifecycle.offline.export.formats import (
    FORMATS,
    JSON_LINES,
    check_export_name,
    check_format,
    format_suffix,
    may_have_masks,
)
from yolov5_lifecycle.offline.image_files import has_still_images
from yolov5_lifecycle.offline.many_recordings.plan import Options, plan_of
from yolov5_lifecycle.offline.many_recordings.supervisor import detect_recordings
from yolov5_lifecycle.offline.many_recordings.tally import RecordingsTerminal, recordings_report
from yolov5_lifecycle.offline.many_recordings.workers import ProcessWorker, Worker, suitable_count
from yolov5_lifecycle.offline.recordings import are_many, is_recording, is_video, recordings_of
from yolov5_lifecycle.offline.terminal import Terminal, missing_images, report
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.process.standard_streams import complain, show_report
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings

EXIT_INCOMPLETE = 3
"""Exit code if a recording has fewer images than it claims, or was set aside as one of many."""


def main(argv: Sequence[str] | None = None, *, prepare: Prepare = prepare_model) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)
    try:
        if arguments.jobs or arguments.ray or are_many(arguments.sources):
            return _run_many(parser, arguments)
        (source,) = arguments.sources
        if not source.exists():
            return _complain(f"{source}: file or folder not found")
        if problem := _usage_problem(source, arguments):
            parser.error(problem)
        with (
            unwound_by_sigterm(),
            closing(Terminal("detect_bag", shows_progress=bool(arguments.output))) as terminal,
        ):
            statistics = _run(source, arguments, terminal, prepare)
    except BrokenPipeError:
        raise  # not reported: the reader closed the output pipe, as with `| head`
    except SettingsError as error:
        problems = "".join(f"\n  {problem}" for problem in error.problems)
        return _complain(f"{len(error.problems)} problem(s) in the settings:{problems}")
    except (ValueError, OSError, ImportError, DetectingError, InferenceError) as error:
        return _complain(str(error))
    except KeyboardInterrupt:
        _complain("interrupted; unfinished output was removed")
        return 130
    show_report(report(statistics))
    if statistics.missing:
        complain(
            "detect_bag", f"{source}: {missing_images(statistics.expected, statistics.balance.received)}"
        )
    return EXIT_INCOMPLETE if statistics.missing else 0


def _run(source: Path, arguments: argparse.Namespace, terminal: Terminal, prepare: Prepare) -> RunStatistics:
    settings = _settings(arguments)
    export = _export(source, arguments)
    with_masks = (export.masks and may_have_masks(export.suffix)) or arguments.images or arguments.annotated
    load = functools.partial(
        OfflineDetector, settings, terminal, with_masks=bool(with_masks), prepare=prepare
    )
    if not is_recording(source):
        return detect_files(source, export, annotated=arguments.annotated, load=load)
    with _rosbags():
        from yolov5_lifecycle.offline.detect_recording import RecordingOptions, detect_recording
    options = RecordingOptions(arguments.topic, arguments.node, arguments.images)
    return detect_recording(source, export, options, load)


def _export(source: Path, arguments: argparse.Namespace) -> Export:
    """The outputs for a single source; raises OutputError for a format that cannot be written."""
    output = arguments.output
    suffix = "" if output is None else format_suffix(output)
    if not is_recording(source):
        if output is not None:
            check_export_name(output)
        suffix = suffix or JSON_LINES
    check_format(suffix)
    crops = output.with_name(f"{output.stem if suffix else output.name}_crops") if arguments.crops else None
    return Export(output, suffix, arguments.masks, crops)


@contextmanager
def _rosbags() -> Iterator[None]:
    """Say how to install rosbags if it cannot be imported."""
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"a package needed to read recordings is missing ({error}). Install it with "
            f"{sys.executable} -m pip install rosbags"
        ) from None


def _settings(arguments: argparse.Namespace) -> Settings:
    return wanted_settings(arguments.params_file, arguments.assignments, arguments.node, arguments.camera)


def _run_many(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    if problem := _usage_problem_of_many(arguments):
        parser.error(problem)
    output = Path(os.path.abspath(arguments.output))  # noqa: PTH100
    settings = _settings(arguments)
    sources = recordings_of(arguments.sources, output)
    suffix = format_suffix(output)
    check_format(suffix)
    if not all(is_video(source.path) for source in sources):
        with _rosbags():
            import yolov5_lifecycle.offline.recording  # noqa: F401
    elif problems := _without_recordings(arguments, "these are videos"):
        parser.error("; ".join(problems))
    options = Options(
        arguments.topic, arguments.node, arguments.images, arguments.masks, suffix, arguments.crops
    )
    plan = plan_of(settings, output, options)
    with unwound_by_sigterm(), closing(RecordingsTerminal()) as terminal:
        new_workers = functools.partial(_workers, arguments.jobs, arguments.ray)
        tally = detect_recordings(sources, plan, new_workers=new_workers, terminal=terminal)
    show_report(recordings_report(tally))
    return 0 if tally.is_complete else EXIT_INCOMPLETE


def _workers(jobs: int | None, ray: str | None, recordings: int) -> Sequence[Worker]:
    """`jobs` workers, or as many as are suitable for `recordings`, on the cluster `ray` or this machine."""
    if ray is None:
        count = suitable_count(recordings, jobs)
        return [ProcessWorker(count) for _ in range(count)]
    if absence := absence_of("ray"):
        raise ImportError(f"--ray needs the package ray: {absence}")
    from yolov5_lifecycle.offline.many_recordings.ray_worker import RayWorker, connected

    processors = connected(ray)
    return [RayWorker() for _ in range(min(jobs or processors, processors, recordings))]


def _complain(problem: str) -> int:
    complain("detect_bag", problem)
    return 1


def _usage_problem(source: Path, arguments: argparse.Namespace) -> str:
    """The conflicts between the arguments for a single source, or ""."""
    if is_recording(source):
        problems = ["give --output, the new recording to write"] if arguments.output is None else []
        if arguments.annotated:
            problems.append("--annotated does not apply to recordings; use --images")
    else:
        problems = _without_recordings(arguments, f"{source} is not one")
        if TRACK in arguments.assignments and has_still_images(source):
            problems.append(f"{source} has still images; tracking needs a recording or a video")
        if arguments.crops and arguments.output is None:
            problems.append("--crops needs --output, beside which it puts the folder of crops")
    return "; ".join([*problems, *_conflicts_with_format(arguments)])


def _usage_problem_of_many(arguments: argparse.Namespace) -> str:
    """The conflicts between the arguments for many sources, or ""."""
    problems = []
    if arguments.output is None:
        problems.append("give --output, the folder for the results of many recordings or videos")
    if arguments.annotated:
        problems.append(
            "--annotated applies to a single video, image or folder of images; for recordings use --images"
        )
    return "; ".join([*problems, *_conflicts_with_format(arguments)])


def _without_recordings(arguments: argparse.Namespace, sources: str) -> list[str]:
    """Which arguments have no effect, because of what `sources` says."""
    return [
        f"--{name} applies to recordings only, and {sources}"
        for name in ("topic", "images")
        if getattr(arguments, name)
    ]


def _conflicts_with_format(arguments: argparse.Namespace) -> list[str]:
    """What the format of the output cannot hold, but the arguments ask for."""
    suffix = "" if arguments.output is None else format_suffix(arguments.output)
    if not suffix:
        return []
    problems = []
    if arguments.images:
        problems.append(f"--images needs a recording as output: give --output without {suffix}")
    if TRACK in arguments.assignments and not FORMATS[suffix].has_ids:
        problems.append(f"{suffix} has no ids of tracks: leave out --track, or choose another format")
    return problems
