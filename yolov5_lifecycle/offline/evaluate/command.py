"""Command `evaluate WEIGHTS DATA`: how good a model is on labelled images, and which thresholds suit it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path

from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.evaluation.curves import matplotlib_problem
from yolov5_lifecycle.evaluation.ground_truth import Problems
from yolov5_lifecycle.evaluation.thresholds import Goal, GoalError
from yolov5_lifecycle.offline.detecting import Account, DetectingError
from yolov5_lifecycle.offline.detector_options import (
    add_detector_options,
    unwound_by_sigterm,
    wanted_settings,
)
from yolov5_lifecycle.offline.evaluate.compared_settings import compared_settings
from yolov5_lifecycle.offline.evaluate.evaluating import NOT_APPLIED, evaluate_models
from yolov5_lifecycle.offline.evaluate.labelled_data import kind_of, labelled_data
from yolov5_lifecycle.offline.evaluate.labelled_images import DataOptions, add_data_options
from yolov5_lifecycle.offline.evaluate.output_files import write_files
from yolov5_lifecycle.offline.evaluate.result import EvaluationResult
from yolov5_lifecycle.offline.terminal import Terminal
from yolov5_lifecycle.process.missing_package import absence_of, import_problem
from yolov5_lifecycle.process.standard_streams import complain, write_output
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.parameter_file import string_assignment
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_COMMAND = "evaluate"
_EVERYWHERE = "detections of any size count anywhere in the image, as labels do"
_USELESS = {
    **dict.fromkeys(NOT_APPLIED, _EVERYWHERE),
    "tracker": "images are evaluated one by one",
    "weights": "the model is WEIGHTS",
}
"""Settings without effect, which command-line arguments may not contain; a parameter file may."""
_EPILOG = """\
DATA is one of
  a folder with images/ and labels/ in YOLO format, or its data.yaml
  a COCO file (.json) next to its images
  a ros2 bag recording with images and corrected detections (Detection2DArray) of the same stamps

examples:
  evaluate best.pt shots
  evaluate best.pt shots/data.yaml --split test --output report
  evaluate best.pt instances_val.json --root images --thresholds f1
  evaluate best.pt drive --topic /front/image_raw --truth-topic /yolov5/front/detections
  evaluate best.pt shots --compare older.pt
  evaluate best.pt shots --compare runtime=openvino,image_size=320
"""


def main(argv: Sequence[str] | None = None, *, prepare: Prepare = prepare_model) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)
    try:
        if not arguments.data.exists():
            return _complain(f"{arguments.data}: file or folder not found")
        if problem := _usage_problem(arguments):
            parser.error(problem)
        with unwound_by_sigterm(), closing(Terminal(_COMMAND, shows_progress=True)) as terminal:
            return _run(arguments, terminal, prepare)
    except SettingsError as error:
        problems = "".join(f"\n  {problem}" for problem in error.problems)
        return _complain(f"{len(error.problems)} problem(s) in the settings:{problems}")
    except ImportError as error:
        return _complain(import_problem(error))
    except (ValueError, OSError, DetectingError, InferenceError) as error:
        return _complain(str(error))
    except KeyboardInterrupt:
        _complain("interrupted; unfinished output was removed")
        return 130


def _run(arguments: argparse.Namespace, terminal: Terminal, prepare: Prepare) -> int:
    settings = _settings(arguments, [])
    wanted = [settings]
    if arguments.compare is not None:
        wanted.append(_settings(arguments, compared_settings(arguments.compare)))
    if problem := absence_of("pycocotools.cocoeval") or (arguments.output and matplotlib_problem()):
        return _complain(problem)
    watch = _Watch(terminal)
    with ExitStack() as stack:
        folder = stack.enter_context(whole_output(arguments.output)) if arguments.output else None
        options = _data_options(arguments)
        data = stack.enter_context(
            labelled_data(arguments.data, options, watch.problems, progress=terminal.begin)
        )
        classes, evaluations = evaluate_models(
            data, wanted, watch=watch, problems=watch.problems, prepare=prepare
        )
        terminal.begin("computing the figures")
        result = EvaluationResult(
            arguments.data, data.kind, classes, evaluations, watch.problems, arguments.thresholds
        )
        text = result.text(arguments.node)
        if folder is not None:
            write_files(
                folder,
                result.as_json(),
                matches=result.matches[0],
                class_names=classes.names,
                threshold=settings.confidence_threshold,
                confusion=result.confusion,
                confused=result.confused,
                images=[evaluation.images for evaluation in evaluations],
            )
        terminal.close()
    return write_output(_COMMAND, text)


def _settings(arguments: argparse.Namespace, further: Sequence[str]) -> Settings:
    """The settings of the model WEIGHTS, with the `further` assignments."""
    weights = string_assignment("weights", arguments.weights)
    assignments = [*arguments.assignments, weights, *further]
    return wanted_settings(arguments.params_file, assignments, arguments.node, arguments.camera)


def _data_options(arguments: argparse.Namespace) -> DataOptions:
    return DataOptions(
        split=arguments.split,
        root=arguments.root,
        topic=arguments.topic,
        truth_topic=arguments.truth_topic,
    )


class _Watch:
    """Shows progress on the terminal, and the first problems; counts all."""

    def __init__(self, terminal: Terminal) -> None:
        self.problems = Problems(self._tell)
        self._terminal = terminal
        self._rejected: set[str] = set()

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        if outcome is Outcome.FAILED:
            self.problems.add("failed images", label, error)
        elif label not in self._rejected:  # once, although each model meets it
            self._rejected.add(label)
            self.problems.add("unusable images", label, error)

    def progress(self, account: Account) -> None:
        self._terminal.progress(account)

    def _tell(self, problem: str) -> None:
        self._terminal.close()
        complain(_COMMAND, problem)


def _complain(problem: str) -> int:
    complain(_COMMAND, problem)
    return 1


def _usage_problem(arguments: argparse.Namespace) -> str:
    """The conflict between command-line arguments, or ""."""
    kind = kind_of(arguments.data)
    compared = [] if arguments.compare is None else compared_settings(arguments.compare)
    if name := _useless(arguments.assignments) or _useless(compared, besides="weights"):
        return f"the setting {name} has no effect: {_USELESS[name]}"
    if useless := _data_options(arguments).useless(kind):
        option = f"--{useless[0].replace('_', '-')}"
        return f"{option} does not apply to {arguments.data}, a data set of the kind {kind}"
    return ""


def _useless(assignments: Sequence[str], *, besides: str = "") -> str:
    """The first setting in `assignments` that has no effect, or ""."""
    names = (assignment.partition("=")[0] for assignment in assignments)
    return next((name for name in names if name in _USELESS and name != besides), "")


def _goal(text: str) -> Goal:
    try:
        return Goal.parsed(text)
    except GoalError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def command_parser() -> argparse.ArgumentParser:
    """The argument parser of the command."""
    parser = CommandParser(
        _COMMAND,
        description="Measure how good a model is on labelled images: precision, recall, F1 and mAP of each\n"
        "class, the confusion matrix, and the time per image.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("weights", metavar="WEIGHTS", help="weights file (.pt or .safetensors)")
    parser.add_argument("data", type=Path, metavar="DATA", help="labelled images, see below")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FOLDER",
        help="new folder for report.json, the curves (PNG) and all detections",
    )
    parser.add_argument(
        "--compare",
        metavar="OTHER",
        help="another weights file, or other parameters as NAME=VALUE[,NAME=VALUE], to compare with; prints "
        "95 %% intervals of the differences",
    )
    parser.add_argument(
        "--thresholds",
        type=_goal,
        metavar="GOAL",
        help="f1, recall=0.9 or precision=0.95: print thresholds that reach it, as detector parameters",
    )
    add_data_options(parser)
    parser.add_argument(
        "--truth-topic",
        metavar="TOPIC",
        help="topic of the corrected detections in a recording (default: the only one)",
    )
    add_detector_options(parser)
    return parser
