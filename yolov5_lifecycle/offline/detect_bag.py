"""Command `detect_bag SOURCE ...`: run the detector on recordings, a video or images, without ROS."""

from __future__ import annotations

import argparse
import functools
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.offline.detect_bag_arguments import TRACK, command_parser
from yolov5_lifecycle.offline.detecting import DetectingError, OfflineDetector, RunStatistics
from yolov5_lifecycle.offline.detector_options import unwound_by_sigterm, wanted_settings
from yolov5_lifecycle.offline.export.exporting import Export, write_files
from yolov5_lifecycle.offline.export.formats import (
    FORMATS,
    JSON_LINES,
    check_export_name,
    check_format,
    format_suffix,
)
from yolov5_lifecycle.offline.image_files import has_still_images
from yolov5_lifecycle.offline.many_recordings.results import plan_of
from yolov5_lifecycle.offline.many_recordings.summary import BatchTerminal
from yolov5_lifecycle.offline.many_recordings.supervisor import detect_recordings
from yolov5_lifecycle.offline.many_recordings.workers import ProcessWorker, Worker, suitable_count
from yolov5_lifecycle.offline.recordings import are_many, is_recording, is_video, recordings_of
from yolov5_lifecycle.offline.terminal import Terminal, missing_images, report
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.process.standard_streams import complain, show_report
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings

EXIT_INCOMPLETE = 3
"""Exit code if a recording has fewer images than it claims, or failed as one of many."""


def main(argv: Sequence[str] | None = None, *, prepare: Prepare = prepare_model) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)
    try:
        if arguments.jobs or arguments.ray or are_many(arguments.sources):
            return _run_many(parser, arguments)
        (source,) = arguments.sources
        if not source.exists():
            return _complain(f"{source}: file or folder not found")
        if problems := _conflicts(source, arguments):
            parser.error("; ".join(problems))
        with (
            unwound_by_sigterm(),
            closing(Terminal("detect_bag", shows_progress=bool(arguments.output))) as terminal,
        ):
            statistics = _run(source, arguments, terminal, prepare)
    except BrokenPipeError:
        raise  # not reported: the reader closed the output pipe, as with `| head`
    except SettingsError as error:
        listing = "".join(f"\n  {problem}" for problem in error.problems)
        return _complain(f"{len(error.problems)} problem(s) in the settings:{listing}")
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
    load = functools.partial(
        OfflineDetector, settings, terminal, with_masks=export.needs_masks, prepare=prepare
    )
    if is_recording(source):
        _check_rosbags()
        from yolov5_lifecycle.offline.detect_recording import write_recording as write
    else:
        write = write_files
    with export.whole() as unfinished:
        return write(source, unfinished, load)


def _export(source: Path, arguments: argparse.Namespace) -> Export:
    """The outputs for a single source; raises OutputError for a format that cannot be written."""
    output = arguments.output
    suffix = "" if output is None else format_suffix(output)
    if not is_recording(source):
        if output is not None:
            check_export_name(output)
        suffix = suffix or JSON_LINES
    crops = output.with_name(f"{output.stem if suffix else output.name}_crops") if arguments.crops else None
    return _export_to(output, suffix, crops, arguments)


def _export_to(path: Path | None, suffix: str, crops: Path | None, arguments: argparse.Namespace) -> Export:
    check_format(suffix)
    return Export(
        path=path,
        suffix=suffix,
        masks=arguments.masks,
        crops=crops,
        annotated=arguments.annotated,
        topic=arguments.topic,
        node=arguments.node,
        images=arguments.images,
    )


def _check_rosbags() -> None:
    """Say how to install rosbags if it cannot be imported."""
    try:
        import yolov5_lifecycle.offline.detect_recording  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"a package needed to read recordings is missing ({error}). Install it with "
            f"{sys.executable} -m pip install rosbags"
        ) from None


def _settings(arguments: argparse.Namespace) -> Settings:
    return wanted_settings(arguments.params_file, arguments.assignments, arguments.node, arguments.camera)


def _run_many(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    if problems := _conflicts_of_many(arguments):
        parser.error("; ".join(problems))
    output = Path(os.path.abspath(arguments.output))  # noqa: PTH100
    settings = _settings(arguments)
    sources = recordings_of(arguments.sources, output)
    export = _export_to(None, format_suffix(output), Path("crops") if arguments.crops else None, arguments)
    if not all(is_video(source.path) for source in sources):
        _check_rosbags()
    elif problems := _without_recordings(arguments, "these are videos"):
        parser.error("; ".join(problems))
    plan = plan_of(settings, output, export)
    with unwound_by_sigterm(), closing(BatchTerminal()) as terminal:
        new_workers = functools.partial(_workers, arguments.jobs, arguments.ray)
        batch = detect_recordings(sources, plan, new_workers=new_workers, terminal=terminal)
    show_report(str(batch))
    return 0 if batch.is_complete else EXIT_INCOMPLETE


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


def _conflicts(source: Path, arguments: argparse.Namespace) -> list[str]:
    """The arguments that contradict each other, for a single source."""
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
    return problems + _conflicts_with_format(arguments)


def _conflicts_of_many(arguments: argparse.Namespace) -> list[str]:
    """The arguments that contradict each other, for many sources."""
    problems = []
    if arguments.output is None:
        problems.append("give --output, the folder for the results of many recordings or videos")
    if arguments.annotated:
        problems.append(
            "--annotated applies to a single video, image or folder of images; for recordings use --images"
        )
    return problems + _conflicts_with_format(arguments)


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
