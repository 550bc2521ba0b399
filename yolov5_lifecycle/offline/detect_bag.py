"""Command `detect_bag SOURCE`: run the detector on a recording, a video or images, without ROS."""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.offline.detect_files import detect_files
from yolov5_lifecycle.offline.detecting import Account, DetectingError, OfflineDetector
from yolov5_lifecycle.offline.detector_options import (
    add_detector_options,
    unwound_by_sigterm,
    wanted_settings,
)
from yolov5_lifecycle.offline.image_files import has_still_images
from yolov5_lifecycle.offline.terminal import Terminal
from yolov5_lifecycle.process.standard_streams import complain
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_TRACK = "tracker=bytetrack"
_RECORDING_SUFFIXES = (".mcap", ".db3")
_EPILOG = """\
examples:
  detect_bag drive --output drive_detections --set weights=best.pt
  detect_bag drive.mcap --topic /front/image_raw --output front --images --params-file yolov5.yaml
  detect_bag drive --output drive_detections -p weights:=best.pt -p confidence_threshold:=0.4
  detect_bag holidays --annotated drawn --output holidays.jsonl
"""


def is_recording(path: Path) -> bool:
    """Whether `path` is a rosbag2 file, possibly compressed, or a folder that contains such files."""
    if not path.is_dir():
        return path.suffix in _RECORDING_SUFFIXES
    return any(suffix in _RECORDING_SUFFIXES for file in path.iterdir() for suffix in file.suffixes)


def report(account: Account) -> str:
    """Summary of a run for the user, one fact per line."""
    balance, objects = account.balance, account.objects
    names = ", ".join(f"{name} {count}" for name, count in objects.most_common())
    missing = f" of {account.expected} announced" if balance.received < account.expected else ""
    return (
        f"images    {balance.received}{missing}: {balance[Outcome.DETECTED]} detected, "
        f"{balance[Outcome.REJECTED]} rejected, {balance[Outcome.FAILED]} failed\n"
        f"detections  {objects.total()}{': ' if names else ''}{names}\n"
        f"rate        {account.rate_hz:.1f} images per second\n"
    )


def main(argv: Sequence[str] | None = None, *, prepare: Prepare = prepare_model) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)
    try:
        if not arguments.source.exists():
            return _complain(f"{arguments.source}: there is no such file or folder")
        if problem := _usage_problem(arguments):
            parser.error(problem)
        with (
            unwound_by_sigterm(),
            closing(Terminal("detect_bag", shows_progress=bool(arguments.output))) as terminal,
        ):
            with_masks = bool(arguments.masks or arguments.images or arguments.annotated)
            load = functools.partial(OfflineDetector, watch=terminal, with_masks=with_masks, prepare=prepare)
            account = _run(arguments, load)
    except BrokenPipeError:
        raise  # not reported: the reader closed the output pipe, as with `| head`
    except SettingsError as error:
        problems = "".join(f"\n  {problem}" for problem in error.problems)
        return _complain(f"{len(error.problems)} problem(s) in the settings:{problems}")
    except (ValueError, OSError, ImportError, DetectingError, InferenceError) as error:
        return _complain(str(error))
    except KeyboardInterrupt:
        _complain("interrupted; what was unfinished is removed")
        return 130
    sys.stderr.write(report(account))
    return 0


def _run(arguments: argparse.Namespace, load: Callable[[Settings], OfflineDetector]) -> Account:
    source, output = arguments.source, arguments.output
    settings = wanted_settings(arguments.params_file, arguments.assignments, arguments.node)
    if not is_recording(source):
        return detect_files(
            source,
            output,
            annotated=arguments.annotated,
            masks=arguments.masks,
            load=lambda: load(settings),
        )
    try:
        from yolov5_lifecycle.offline.detect_recording import detect_recording
    except ImportError as error:
        raise ImportError(
            f"a package is missing that reads recordings ({error}). Install it with "
            f"{sys.executable} -m pip install rosbags"
        ) from None
    return detect_recording(
        source,
        output,
        topic=arguments.topic,
        node=arguments.node,
        images=arguments.images,
        masks=arguments.masks,
        load=lambda: load(settings),
    )


def _complain(problem: str) -> int:
    complain("detect_bag", problem)
    return 1


def _usage_problem(arguments: argparse.Namespace) -> str:
    """The conflict between command-line arguments, or ""."""
    if is_recording(arguments.source):
        if arguments.output is None:
            return "give --output, the recording to be written"
        return "a recording has no use for --annotated; give --images" if arguments.annotated else ""
    if _TRACK in arguments.assignments and has_still_images(arguments.source):
        return f"{arguments.source} has no time in it; only recordings and videos are tracked"
    useless = [name for name in ("topic", "images") if getattr(arguments, name)]
    return f"{arguments.source} is no recording; only those have a use for --{useless[0]}" if useless else ""


def command_parser() -> argparse.ArgumentParser:
    """The argument parser of the command."""
    parser = CommandParser(
        "detect_bag",
        description="Detect objects in every image of a recording, a video or a folder of images.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "source", type=Path, metavar="SOURCE", help="a recording of ros2 bag, a video, an image or a folder"
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="PATH",
        help="new recording with the detections; for images, new file with JSON lines (default: stdout)",
    )
    parser.add_argument("--topic", help="which images of the recording (default: the only ones)")
    parser.add_argument("--images", action="store_true", help="put annotated images into the new recording")
    parser.add_argument(
        "--annotated", type=Path, metavar="PATH", help="new annotated video, image or folder of images"
    )
    parser.add_argument(
        "--no-masks",
        action="store_false",
        dest="masks",
        help="write no masks of a model that segments; annotated images show them all the same",
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
