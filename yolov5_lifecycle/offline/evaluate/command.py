"""Command `evaluate WEIGHTS DATA`: how good a model is on labelled images, and which thresholds suit it."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path

from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.evaluation.coco_file import read_coco_file
from yolov5_lifecycle.evaluation.ground_truth import DataError, LabelledFolder, Problems
from yolov5_lifecycle.evaluation.yolo_folder import YAML_SUFFIXES, read_yolo_folder
from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.detector_options import wanted_settings
from yolov5_lifecycle.offline.evaluate.arguments import command_parser
from yolov5_lifecycle.offline.evaluate.evaluating import NOT_APPLIED, evaluate_models
from yolov5_lifecycle.offline.evaluate.result import EvaluationResult
from yolov5_lifecycle.offline.recordings import is_recording
from yolov5_lifecycle.offline.terminal import Terminal, exit_code
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.process.standard_streams import write_output
from yolov5_lifecycle.settings.parameter_file import string_assignment
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_COMMAND = "evaluate"
_BETWEEN_ASSIGNMENTS = re.compile(r",(?=[a-z_0-9]+=)")
_ASSIGNMENT = re.compile(r"[a-z_0-9]+=")
_EVERYWHERE = "detections of any size count anywhere in the image, as labels do"
_USELESS = {
    **dict.fromkeys(NOT_APPLIED, _EVERYWHERE),
    "tracker": "images are evaluated one by one",
    "weights": "the model is WEIGHTS",
}
"""Settings without effect, which command-line arguments may not contain; a parameter file may."""


def main(argv: Sequence[str] | None = None, *, prepare: Prepare = prepare_model) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)

    def run() -> int:
        if not arguments.data.exists():
            raise FileNotFoundError(f"{arguments.data}: file or folder not found")
        kind = _kind_of(arguments.data)
        if problem := _usage_problem(arguments, kind):
            parser.error(problem)
        with closing(_Reports()) as reports:
            return write_output(_COMMAND, _evaluated(arguments, kind, reports, prepare))

    return exit_code(_COMMAND, run)


def _kind_of(data: Path) -> str:
    """`YOLO` or `COCO`; raises DataError for anything else."""
    is_folder, suffix = data.is_dir(), data.suffix.lower()
    if suffix == ".json" and not is_folder:
        return "COCO"
    if suffix in YAML_SUFFIXES and not is_folder:
        return "YOLO"
    if is_recording(data):
        raise DataError(
            f"{data}: expected labelled images, found a recording: play it to a detector with "
            "`collect: true` and a `collect_dir`, correct the labels there, and name that folder."
        )
    if is_folder:
        return "YOLO"
    raise DataError(
        f"{data}: expected a folder with images/ and labels/, its data.yaml or a COCO file (.json)."
    )


def _labelled(arguments: argparse.Namespace, kind: str, problems: Problems) -> LabelledFolder:
    """The images and labels; raises DataError if nothing can be used, and OSError."""
    if kind == "COCO":
        return read_coco_file(arguments.data, problems, root=arguments.root)
    return read_yolo_folder(arguments.data, problems, split=arguments.split, root=arguments.root)


def _evaluated(arguments: argparse.Namespace, kind: str, reports: _Reports, prepare: Prepare) -> str:
    """What is printed; the files are written."""
    wanted = [_settings(arguments, [])]
    if arguments.compare is not None:
        wanted.append(_settings(arguments, _compared(arguments.compare)))
    if problem := absence_of("pycocotools.cocoeval"):
        raise DetectingError(problem)
    with ExitStack() as stack:
        folder = stack.enter_context(whole_output(arguments.output)) if arguments.output else None
        reports.begin("reading the labels")
        data = _labelled(arguments, kind, reports.problems)
        classes, evaluations = evaluate_models(
            data, wanted, observer=reports, problems=reports.problems, prepare=prepare
        )
        reports.begin("computing the figures")
        result = EvaluationResult(
            arguments.data, kind, classes, evaluations, reports.problems, arguments.thresholds
        )
        text = result.text(arguments.node)
        reports.close()
        if folder is not None:
            try:
                result.write(folder)
            except OSError:
                write_output(_COMMAND, text)  # they may be the work of hours
                raise
    return text


def _compared(other: str) -> list[str]:
    """Assignments `name=value` of `other`: `name=value[,name=value]`, or the path of a weights file.

    A file whose name looks like an assignment is given as `./name=value.pt`.
    """
    if _ASSIGNMENT.match(other):
        return _BETWEEN_ASSIGNMENTS.split(other)
    return [string_assignment("weights", other)]


def _settings(arguments: argparse.Namespace, further: Sequence[str]) -> Settings:
    """The settings of the model WEIGHTS, with the `further` assignments."""
    weights = string_assignment("weights", arguments.weights)
    assignments = [*arguments.assignments, weights, *further]
    return wanted_settings(arguments.params_file, assignments, arguments.node, arguments.camera)


class _Reports(Terminal):
    """Images that cannot be used are among the `problems`, of which the first are told."""

    def __init__(self) -> None:
        super().__init__(_COMMAND, shows_progress=True)
        self.problems = Problems(self.tell)
        self._rejected: set[str] = set()

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        if outcome is Outcome.FAILED:
            self.problems.add("failed images", label, error)
        elif label not in self._rejected:  # once, although each model meets it
            self._rejected.add(label)
            self.problems.add("unusable images", label, error)


def _usage_problem(arguments: argparse.Namespace, kind: str) -> str:
    """The conflict between command-line arguments, or ""."""
    compared = [] if arguments.compare is None else _compared(arguments.compare)
    named, named_other = (
        {assignment.partition("=")[0] for assignment in assignments}
        for assignments in (arguments.assignments, compared)
    )
    useless = (named | named_other - {"weights"}) & _USELESS.keys()
    problems = [f"the setting {name} has no effect: {_USELESS[name]}" for name in sorted(useless)]
    if kind == "COCO" and arguments.split is not None:
        problems.append(f"--split does not apply to {arguments.data}, a COCO file")
    return "; ".join(problems)
