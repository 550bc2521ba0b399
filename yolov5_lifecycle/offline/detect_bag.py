"""Command `detect_bag SOURCE ...`: run the detector on recordings, a video or images, without ROS."""

from __future__ import annotations

import argparse
import functools
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.offline.batch.plan import plan_of
from yolov5_lifecycle.offline.batch.supervisor import detect_recordings
from yolov5_lifecycle.offline.batch.terminal import BatchTerminal, batch_report
from yolov5_lifecycle.offline.batch.worker_pool import ProcessWorkers, suitable_count
from yolov5_lifecycle.offline.batch.workers import Workers
from yolov5_lifecycle.offline.detect_files import detect_files
from yolov5_lifecycle.offline.detecting import Account, DetectingError, OfflineDetector
from yolov5_lifecycle.offline.detector_options import (
    add_detector_options,
    unwound_by_sigterm,
    wanted_settings,
)
from yolov5_lifecycle.offline.image_files import has_still_images
from yolov5_lifecycle.offline.recordings import are_many, is_recording, recordings_of
from yolov5_lifecycle.offline.terminal import Terminal, report
from yolov5_lifecycle.process.standard_streams import complain, show_report
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings

_TRACK = "tracker=bytetrack"
EXIT_SET_ASIDE = 3
"""Exit code if some of many recordings were set aside."""
_MAX_JOBS = 1024
_EPILOG = """\
examples:
  detect_bag drive --output drive_detections --set weights=best.pt
  detect_bag drive.mcap --topic /front/image_raw --output front --images --params-file yolov5.yaml
  detect_bag drive --output drive_detections -p weights:=best.pt -p confidence_threshold:=0.4
  detect_bag holidays --annotated drawn --output holidays.jsonl
  detect_bag 'drives/*' --output found --jobs 4 --set weights=best.pt

With many recordings (several paths, a quoted pattern, or a folder of recordings), PATH is a folder. It gets
a new recording for each, and summary.json and summary.parquet with the detection counts. Run again, the same
command does only what is missing. A recording that cannot be used is set aside; the exit code is then 3.
"""


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
            with_masks = bool(arguments.masks or arguments.images or arguments.annotated)
            load = functools.partial(OfflineDetector, watch=terminal, with_masks=with_masks, prepare=prepare)
            account = _run(source, arguments, load)
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
    show_report(report(account))
    return 0


def _run(source: Path, arguments: argparse.Namespace, load: Callable[[Settings], OfflineDetector]) -> Account:
    output = arguments.output
    settings = _settings(arguments)
    if not is_recording(source):
        return detect_files(
            source,
            output,
            annotated=arguments.annotated,
            masks=arguments.masks,
            load=lambda: load(settings),
        )
    with _rosbags():
        from yolov5_lifecycle.offline.detect_recording import detect_recording
    return detect_recording(
        source,
        output,
        topic=arguments.topic,
        node=arguments.node,
        images=arguments.images,
        masks=arguments.masks,
        load=lambda: load(settings),
    )


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
    if arguments.output is None:
        parser.error("give --output, the folder for the results of many recordings")
    if arguments.annotated:
        parser.error("--annotated does not apply to recordings; use --images")
    output = Path(os.path.abspath(arguments.output))  # noqa: PTH100
    settings = _settings(arguments)
    sources = recordings_of(arguments.sources, output)
    with _rosbags():
        import yolov5_lifecycle.offline.recording  # noqa: F401
    plan = plan_of(
        settings,
        output=output,
        topic=arguments.topic,
        node=arguments.node,
        images=arguments.images,
        masks=arguments.masks,
    )
    with unwound_by_sigterm(), closing(BatchTerminal()) as terminal:
        new_workers = functools.partial(_workers, arguments.jobs, arguments.ray)
        tally = detect_recordings(sources, plan, new_workers=new_workers, watch=terminal)
    show_report(batch_report(tally))
    return EXIT_SET_ASIDE if tally.in_state("set aside") else 0


def _workers(jobs: int | None, ray: str | None, recordings: int) -> Workers:
    """`jobs` workers, or as many as are suitable for `recordings`, on the cluster `ray` or this machine."""
    if ray is None:
        return ProcessWorkers(min(jobs, recordings) if jobs else suitable_count(recordings))
    from yolov5_lifecycle.offline.batch.ray_cluster import ray_workers

    return ray_workers(ray, jobs, recordings)


def _complain(problem: str) -> int:
    complain("detect_bag", problem)
    return 1


def _usage_problem(source: Path, arguments: argparse.Namespace) -> str:
    """The conflict between command-line arguments, or ""."""
    if is_recording(source):
        if arguments.output is None:
            return "give --output, the new recording to write"
        return "--annotated does not apply to recordings; use --images" if arguments.annotated else ""
    if _TRACK in arguments.assignments and has_still_images(source):
        return f"{source} has still images; tracking needs a recording or a video"
    useless = [name for name in ("topic", "images") if getattr(arguments, name)]
    return f"--{useless[0]} applies to recordings only, and {source} is not one" if useless else ""


def command_parser() -> argparse.ArgumentParser:
    """The argument parser of the command."""
    parser = CommandParser(
        "detect_bag",
        description="Detect objects in every image of a recording, a video or a folder of images.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "sources",
        nargs="+",
        type=Path,
        metavar="SOURCE",
        help="a ros2 bag recording, a video, an image or a folder of images; or many recordings",
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="PATH",
        help="new recording with the detections; for images or a video, new file of JSON lines (default: "
        "stdout); for many recordings, a folder",
    )
    parser.add_argument(
        "--jobs",
        type=_job_count,
        metavar="N",
        help="processes for many recordings (default: one per core, but at most one per GiB of free memory)",
    )
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="process many recordings on the Ray cluster at ADDRESS, such as auto or 10.0.0.1:6379",
    )
    parser.add_argument("--topic", help="image topic of the recording (default: the only one)")
    parser.add_argument(
        "--images", action="store_true", help="also write annotated images to the new recording"
    )
    parser.add_argument(
        "--annotated", type=Path, metavar="PATH", help="new annotated video, image or folder of images"
    )
    parser.add_argument(
        "--no-masks",
        action="store_false",
        dest="masks",
        help="do not write the masks of a segmentation model; annotated images still show them",
    )
    add_detector_options(parser)
    parser.add_argument(
        "--track",
        action="append_const",
        dest="assignments",
        const=_TRACK,
        help=f"give the same object the same id in every image; short for --set {_TRACK}",
    )
    return parser


def _job_count(text: str) -> int:
    if not text.isascii() or not text.isdecimal() or not 1 <= int(text[:9]) <= _MAX_JOBS:
        raise argparse.ArgumentTypeError(
            f"expected a number of processes from 1 to {_MAX_JOBS}, found {text!r}"
        )
    return int(text)
