"""Command `detect_bag SOURCE ...`: run the detector on recordings, a video or images, without ROS."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.offline.detect_bag_arguments import TRACK, command_parser
from yolov5_lifecycle.offline.detecting import OfflineDetector, RunStatistics, prepared_for
from yolov5_lifecycle.offline.detector_options import wanted_settings
from yolov5_lifecycle.offline.export.exporting import Export, write_files
from yolov5_lifecycle.offline.export.formats import (
    FORMATS,
    JSON_LINES,
    check_export_name,
    format_suffix,
)
from yolov5_lifecycle.offline.image_files import has_still_images
from yolov5_lifecycle.offline.many_recordings.results import plan_of
from yolov5_lifecycle.offline.many_recordings.supervisor import detect_recordings
from yolov5_lifecycle.offline.recordings import are_many, is_recording, is_video, recordings_of
from yolov5_lifecycle.offline.terminal import Terminal, exit_code, missing_images, report
from yolov5_lifecycle.process.standard_streams import complain, show_report
from yolov5_lifecycle.settings.settings import Settings

_COMMAND = "detect_bag"
EXIT_INCOMPLETE = 3
"""Exit code if a recording has fewer images than it claims, or failed as one of many."""


def main(argv: Sequence[str] | None = None, *, prepare: Prepare = prepare_model) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)

    def run() -> int:
        for source in arguments.sources:
            if not source.exists():
                hint = "; leave out quotes around a pattern" if "*" in source.name else ""
                raise FileNotFoundError(f"{source}: file or folder not found{hint}")
        if arguments.jobs or are_many(arguments.sources):
            return _run_many(parser, arguments)
        return _run(parser, arguments, prepare)

    return exit_code(_COMMAND, run)


def _run(parser: argparse.ArgumentParser, arguments: argparse.Namespace, prepare: Prepare) -> int:
    (source,) = arguments.sources
    _check_arguments(parser, arguments, source)
    with closing(Terminal(_COMMAND, shows_progress=bool(arguments.output))) as terminal:
        statistics = _detected(source, arguments, terminal, prepare)
    lines = report(statistics.counts, statistics.objects, expected=statistics.expected)
    show_report(f"{lines}rate        {statistics.rate_hz:.1f} images per second\n")
    if not statistics.missing:
        return 0
    complain(_COMMAND, f"{source}: {missing_images(statistics.expected, statistics.outcomes.total())}")
    return EXIT_INCOMPLETE


def _detected(
    source: Path, arguments: argparse.Namespace, terminal: Terminal, prepare: Prepare
) -> RunStatistics:
    settings, output = _settings(arguments), arguments.output
    suffix = "" if output is None else format_suffix(output)
    if is_recording(source):
        from yolov5_lifecycle.offline.detect_recording import write_recording as write  # rosbags is an extra
    else:
        if output is not None:
            check_export_name(output)
        suffix, write = suffix or JSON_LINES, write_files
    export = _export(arguments, output, suffix)

    def load() -> OfflineDetector:
        prepared = prepared_for(settings, prepare)
        return OfflineDetector(settings, prepared, terminal, with_masks=export.needs_masks)

    with export.whole() as unfinished:
        return write(source, unfinished, load)


def _run_many(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    _check_arguments(parser, arguments, None)
    output = Path(os.path.abspath(arguments.output))  # noqa: PTH100
    settings = _settings(arguments)
    sources = recordings_of(arguments.sources, output)
    if all(is_video(source.path) for source in sources):
        _refuse(parser, _of_recordings(arguments))
    else:
        import yolov5_lifecycle.offline.detect_recording  # noqa: F401 - to say at once that rosbags is missing
    plan = plan_of(settings, output, _export(arguments, None, format_suffix(output)))
    with closing(Terminal(_COMMAND, shows_progress=True)) as terminal:
        batch = detect_recordings(sources, plan, jobs=arguments.jobs, terminal=terminal)
    show_report(str(batch))
    return 0 if batch.is_complete else EXIT_INCOMPLETE


def _export(arguments: argparse.Namespace, path: Path | None, suffix: str) -> Export:
    crops = Path("crops")
    if path is not None:
        crops = path.with_name(f"{path.stem if format_suffix(path) else path.name}_crops")
    return Export(
        path=path,
        suffix=suffix,
        crops=crops if arguments.crops else None,
        **{name: getattr(arguments, name) for name in ("masks", "annotated", "topic", "node", "images")},
    )


def _settings(arguments: argparse.Namespace) -> Settings:
    return wanted_settings(arguments.params_file, arguments.assignments, arguments.node, arguments.camera)


def _check_arguments(
    parser: argparse.ArgumentParser, arguments: argparse.Namespace, source: Path | None
) -> None:
    """Exit if arguments contradict each other; `source` None stands for many recordings or videos."""
    is_bag = source is not None and is_recording(source)
    is_file = source is not None and not is_bag
    has_output, is_tracked = arguments.output is not None, TRACK in arguments.assignments
    suffix = format_suffix(arguments.output) if has_output else ""
    rules = {
        "give --output, the folder for the results of many recordings or videos": not (source or has_output),
        "give --output, the new recording to write": is_bag and not has_output,
        "--annotated applies to a single video, image or folder of images; for recordings use --images": (
            arguments.annotated and not is_file
        ),
        **(_of_recordings(arguments) if is_file else {}),
        f"{source} has still images; tracking needs a recording or a video": (
            is_tracked and source is not None and not is_bag and has_still_images(source)
        ),
        "--crops needs --output, beside which it puts the folder of crops": (
            arguments.crops and is_file and not has_output
        ),
        f"--images needs a recording as output: give --output without {suffix}": suffix and arguments.images,
        f"{suffix} has no ids of tracks: leave out --track, or choose another format": (
            suffix and is_tracked and not FORMATS[suffix].has_ids
        ),
    }
    _refuse(parser, rules)


def _of_recordings(arguments: argparse.Namespace) -> dict[str, object]:
    return {f"--{name} applies to recordings only": getattr(arguments, name) for name in ("topic", "images")}


def _refuse(parser: argparse.ArgumentParser, rules: Mapping[str, object]) -> None:
    """Exit with the texts of all `rules` that are broken."""
    if problems := [problem for problem, is_broken in rules.items() if is_broken]:
        parser.error("; ".join(problems))
