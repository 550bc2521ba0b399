"""Command `detect_bag SOURCE`: the detector over a recording, a video or pictures, without ROS."""

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

from yolov5_lifecycle.frame_balance import Outcome
from yolov5_lifecycle.offline.detect_files import detect_files
from yolov5_lifecycle.offline.detecting import Account, DetectingError, OfflineDetector
from yolov5_lifecycle.parameter_file import assigned_value, file_values
from yolov5_lifecycle.preparation import Prepare, prepare_model
from yolov5_lifecycle.progress import show_progress
from yolov5_lifecycle.rate import RateLimit
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings import Problem, Settings, SettingsError, validated

_OF_THE_NODE = ("autostart", "image_reliability", "image_transport", "lazy", "max_rate")
"""Settings without a meaning here; a parameter file may have them, nobody sets them on purpose."""
_RECORDING_SUFFIXES = (".mcap", ".db3")
_MAX_TOLD = 10
_PROGRESS_HZ = 10.0
_EPILOG = """\
examples:
  detect_bag drive --output drive_detections --set weights=best.pt
  detect_bag drive.mcap --topic /front/image_raw --output front --images --params-file yolov5.yaml
  detect_bag holidays --annotated drawn --output holidays.jsonl
"""


def is_recording(path: Path) -> bool:
    """Whether `path` is a file of rosbag2 or a folder with such files, which may be compressed."""
    if not path.is_dir():
        return path.suffix in _RECORDING_SUFFIXES
    return any(suffix in _RECORDING_SUFFIXES for file in path.iterdir() for suffix in file.suffixes)


def wanted_settings(parameter_file: Path | None, assignments: Sequence[str], node: str) -> Settings:
    """What the node called `node` would obey: the parameter file and over it `name=value` assignments.

    Raises ParameterFileError, SettingsError and OSError.
    """
    values = file_values(parameter_file, node) if parameter_file else {}
    assigned = dict(assigned_value(assignment) for assignment in assignments)
    useless = [
        Problem(name, "it is about images that arrive; here every image is taken from its file.")
        for name in _OF_THE_NODE
        if name in assigned
    ]
    if useless:
        raise SettingsError(useless)
    return validated(values | assigned)


def report(account: Account) -> str:
    """What a user wants to know of a run, one fact a line."""
    balance, objects = account.balance, account.objects
    names = ", ".join(f"{name} {count}" for name, count in objects.most_common())
    missing = f" of {account.expected} announced" if balance.received < account.expected else ""
    return (
        f"pictures    {balance.received}{missing}: {balance[Outcome.DETECTED]} detected, "
        f"{balance[Outcome.REJECTED]} rejected, {balance[Outcome.FAILED]} failed\n"
        f"detections  {objects.total()}{': ' if names else ''}{names}\n"
        f"rate        {account.rate_hz:.1f} pictures per second\n"
    )


def main(argv: Sequence[str] | None = None, *, prepare: Prepare = prepare_model) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)
    try:
        if problem := _usage_problem(arguments):
            parser.error(problem)
        with _unwound_by_sigterm(), closing(_Terminal(shows_progress=bool(arguments.output))) as terminal:
            account = _run(arguments, functools.partial(OfflineDetector, watch=terminal, prepare=prepare))
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
    if not source.exists():
        raise FileNotFoundError(f"{source}: there is no such file or folder")
    settings = wanted_settings(arguments.params_file, arguments.assignments, arguments.node)
    if not is_recording(source):
        return detect_files(source, output, annotated=arguments.annotated, load=lambda: load(settings))
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
        load=lambda: load(settings),
    )


class _Terminal:
    """Tells on stderr how it goes: the first problems, and the progress where no lines go to stdout."""

    def __init__(self, *, shows_progress: bool) -> None:
        self._shows_progress = shows_progress
        self._lost = 0
        self._rate_limit = RateLimit()
        self._is_line_open = False

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        self._lost += 1
        if self._lost <= _MAX_TOLD:
            self.close()
            _complain(f"{label}: {outcome.value}: {error}")
        if self._lost == _MAX_TOLD:
            _complain("further ones are only counted")

    def progress(self, account: Account) -> None:
        if self._shows_progress and self._rate_limit.admits(time.monotonic(), _PROGRESS_HZ):
            of_all = f" of {account.expected}" if account.expected else ""
            text = f"{account.balance.received}{of_all} pictures, {account.rate_hz:.1f} per second"
            show_progress(f"{text:<60}")  # over all of a longer one
            self._is_line_open = True

    def close(self) -> None:
        """End the line of the progress."""
        if self._is_line_open:
            show_progress("", done=True)
        self._is_line_open = False


def _complain(problem: str) -> int:
    sys.stderr.write(f"detect_bag: {problem}\n")
    return 1


def _usage_problem(arguments: argparse.Namespace) -> str:
    """What does not go together on the command line, "" when all does."""
    if is_recording(arguments.source):
        if arguments.output is None:
            return "give --output, the recording to be written"
        return "a recording has no use for --annotated; give --images" if arguments.annotated else ""
    useless = [name for name in ("topic", "images") if getattr(arguments, name)]
    return f"{arguments.source} is no recording; only those have a use for --{useless[0]}" if useless else ""


def command_parser() -> argparse.ArgumentParser:
    """What the command understands."""
    parser = argparse.ArgumentParser(
        prog="detect_bag",
        description="Detect objects in every image of a recording, a video or a folder of pictures.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "source", type=Path, metavar="SOURCE", help="a recording of ros2 bag, a video, a picture or a folder"
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="PATH",
        help="new recording with the detections; for pictures, new file with JSON lines (default: stdout)",
    )
    parser.add_argument("--topic", help="which images of the recording (default: the only ones)")
    parser.add_argument("--images", action="store_true", help="put annotated images into the new recording")
    parser.add_argument(
        "--annotated", type=Path, metavar="PATH", help="new annotated video, picture or folder of pictures"
    )
    parser.add_argument(
        "--params-file", type=Path, metavar="FILE.yaml", help="parameters as the detector is given them"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="assignments",
        metavar="NAME=VALUE",
        help="a parameter of the detector, over those of the file; may be repeated",
    )
    parser.add_argument(
        "--node",
        type=_node_name,
        default="/yolov5",
        help="name of the detector in the file and in topics (default: %(default)s)",
    )
    return parser


def _node_name(text: str) -> str:
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text!r} is no full name of a node, such as /robot/yolov5")
    return text


@contextmanager
def _unwound_by_sigterm() -> Iterator[None]:
    """Ended from outside, what is unfinished must be removed as well."""
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
