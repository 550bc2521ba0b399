"""Command `detect_bag SOURCE`: run the detector on a recording, a video or images, without ROS."""

from __future__ import annotations

import argparse
import functools
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.offline.detect_files import detect_files
from yolov5_lifecycle.offline.detecting import Account, DetectingError, OfflineDetector
from yolov5_lifecycle.offline.image_files import has_still_images
from yolov5_lifecycle.process.standard_streams import complain, show_progress
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.parameter_file import assigned_value, file_values
from yolov5_lifecycle.settings.schema import Problem, SettingsError
from yolov5_lifecycle.settings.settings import Settings, validated
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_OF_THE_NODE = ("autostart", "bond_timeout", "image_reliability", "image_transport", "lazy", "max_rate")
"""Settings without effect offline; a parameter file may contain them, command-line arguments may not."""
_TRACK = "tracker=bytetrack"
_RECORDING_SUFFIXES = (".mcap", ".db3")
_MAX_TOLD = 10
_PROGRESS_PERIOD_S = 0.1
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


def wanted_settings(parameter_file: Path | None, assignments: Sequence[str], node: str) -> Settings:
    """Settings of the node named `node`: the parameter file, overridden by `name=value` assignments.

    Raises ParameterFileError, SettingsError and OSError.
    """
    values = file_values(parameter_file, node) if parameter_file else {}
    assigned = dict(assigned_value(assignment) for assignment in assignments)
    useless = [
        Problem(name, "it is about a node and images that arrive; here every image is taken from its file.")
        for name in _OF_THE_NODE
        if name in assigned
    ]
    if useless:
        raise SettingsError(useless)
    return validated(values | assigned)


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
        with _unwound_by_sigterm(), closing(_Terminal(shows_progress=bool(arguments.output))) as terminal:
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


class _Terminal:
    """Reports on stderr: the first problems, and progress if no lines go to stdout."""

    def __init__(self, *, shows_progress: bool) -> None:
        self._shows_progress = shows_progress
        self._lost = 0
        self._due_s = 0.0
        self._is_line_open = False

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        self._lost += 1
        if self._lost <= _MAX_TOLD:
            self.close()
            _complain(f"{label}: {outcome.value}: {error}")
        if self._lost == _MAX_TOLD:
            _complain("further ones are only counted")

    def progress(self, account: Account) -> None:
        now_s = time.monotonic()
        if self._shows_progress and now_s >= self._due_s:
            self._due_s = now_s + _PROGRESS_PERIOD_S
            of_all = f" of {account.expected}" if account.expected else ""
            text = f"{account.balance.received}{of_all} images, {account.rate_hz:.1f} per second"
            show_progress(f"{text:<60}")  # padded to overwrite a longer text
            self._is_line_open = True

    def close(self) -> None:
        """End the progress line."""
        if self._is_line_open:
            show_progress("", done=True)
        self._is_line_open = False


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
    _add_detector_options(parser)
    return parser


def _add_detector_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--params-file", type=Path, metavar="FILE.yaml", help="parameters as the detector is given them"
    )
    for option, form in (("--set", "NAME=VALUE"), ("-p", "NAME:=VALUE")):
        parser.add_argument(
            option,
            action="append",
            default=[],
            type=_assignment,
            dest="assignments",
            metavar=form,
            help="a parameter of the detector, over those of the file; may be repeated",
        )
    parser.add_argument(
        "--track",
        action="append_const",
        dest="assignments",
        const=_TRACK,
        help=f"give the same object the same id in every image; short for --set {_TRACK}",
    )
    parser.add_argument(
        "--node",
        type=_node_name,
        default="/yolov5",
        help="name of the detector in the file and in topics (default: %(default)s)",
    )


def _assignment(text: str) -> str:
    """Convert `NAME:=VALUE`, as after --ros-args, to `NAME=VALUE`."""
    name, equals, value = text.partition("=")
    return f"{name.removesuffix(':')}{equals}{value}"


def _node_name(text: str) -> str:
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text!r} is no full name of a node, such as /robot/yolov5")
    return text


@contextmanager
def _unwound_by_sigterm() -> Iterator[None]:
    """Unwind on SIGTERM, so that unfinished output is removed."""
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
