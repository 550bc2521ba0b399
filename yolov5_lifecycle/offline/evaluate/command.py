"""Command `evaluate WEIGHTS DATA`: how good a model is on labelled images, and which thresholds suit it."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import fields

from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.evaluation.ground_truth import Problems
from yolov5_lifecycle.offline.detecting import DetectingError, RunStatistics
from yolov5_lifecycle.offline.detector_options import unwound_by_sigterm, wanted_settings
from yolov5_lifecycle.offline.evaluate.arguments import DataOptions, command_parser
from yolov5_lifecycle.offline.evaluate.evaluating import NOT_APPLIED, evaluate_models
from yolov5_lifecycle.offline.evaluate.labelled_data import kind_of, labelled_data
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
    wanted = [_settings(arguments, [])]
    if arguments.compare is not None:
        wanted.append(_settings(arguments, _compared(arguments.compare)))
    problem = absence_of("pycocotools.cocoeval")
    if not problem and arguments.output:
        problem = absence_of("matplotlib.figure")
    if problem:
        return _complain(problem)
    listener = _Listener(terminal)
    with ExitStack() as stack:
        folder = stack.enter_context(whole_output(arguments.output)) if arguments.output else None
        opened = labelled_data(arguments.data, _data_options(arguments), listener.problems)
        data = stack.enter_context(opened)
        classes, evaluations = evaluate_models(
            data, wanted, listener=listener, problems=listener.problems, prepare=prepare
        )
        terminal.begin("computing the figures")
        result = EvaluationResult(
            arguments.data, data.kind, classes, evaluations, listener.problems, arguments.thresholds
        )
        text = result.text(arguments.node)
        if folder is not None:
            result.write(folder)
        terminal.close()
    return write_output(_COMMAND, text)


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


def _data_options(arguments: argparse.Namespace) -> DataOptions:
    return DataOptions(**{field.name: getattr(arguments, field.name) for field in fields(DataOptions)})


class _Listener:
    """Shows progress on the terminal, and the first problems; counts all."""

    def __init__(self, terminal: Terminal) -> None:
        self.problems = Problems(self._tell, progress=terminal.begin)
        self._terminal = terminal
        self._rejected: set[str] = set()

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        if outcome is Outcome.FAILED:
            self.problems.add("failed images", label, error)
        elif label not in self._rejected:  # once, although each model meets it
            self._rejected.add(label)
            self.problems.add("unusable images", label, error)

    def progress(self, statistics: RunStatistics) -> None:
        self._terminal.progress(statistics)

    def _tell(self, problem: str) -> None:
        self._terminal.close()
        complain(_COMMAND, problem)


def _complain(problem: str) -> int:
    complain(_COMMAND, problem)
    return 1


def _usage_problem(arguments: argparse.Namespace) -> str:
    """The conflict between command-line arguments, or ""."""
    kind = kind_of(arguments.data)
    compared = [] if arguments.compare is None else _compared(arguments.compare)
    named, named_other = (
        {assignment.partition("=")[0] for assignment in assignments}
        for assignments in (arguments.assignments, compared)
    )
    useless = (named | named_other - {"weights"}) & _USELESS.keys()
    problems = [f"the setting {name} has no effect: {_USELESS[name]}" for name in sorted(useless)]
    for name in _data_options(arguments).useless(kind):
        option = f"--{name.replace('_', '-')}"
        problems.append(f"{option} does not apply to {arguments.data}, a data set of the kind {kind}")
    return "; ".join(problems)
