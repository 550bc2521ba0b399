"""Command `calibrate WEIGHTS DATA`: learn how to run a model in int8, and measure whether it pays."""

from __future__ import annotations

import argparse
import functools
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detector import check_image_size
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.evaluation.ground_truth import Problems
from yolov5_lifecycle.models.cost import checked_cost, size_multiple
from yolov5_lifecycle.offline.calibrate.arguments import command_parser
from yolov5_lifecycle.offline.calibrate.calibrating import SENSITIVITY_FRAMES, Calibrating
from yolov5_lifecycle.offline.calibrate.calibration_data import CalibrationData, read_calibration_data
from yolov5_lifecycle.offline.calibrate.calibration_frames import fitted
from yolov5_lifecycle.offline.calibrate.map_loss import MapLoss
from yolov5_lifecycle.offline.detecting import Account
from yolov5_lifecycle.offline.evaluate.data_options import DataOptions
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import complain, show_progress, write_output
from yolov5_lifecycle.quantization.calibration_file import Calibration, path_beside, write_calibration
from yolov5_lifecycle.quantization.precision_choice import choice_of, quality_problem
from yolov5_lifecycle.runtimes.registry import COARSE_RUNTIME, RuntimeAbsentError, installed_runtimes
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.settings import Settings, validated
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_MAX_TOLD = 10
_MAX_PATH = 4096


def main(argv: Sequence[str] | None = None) -> int:
    arguments = command_parser().parse_args(argv)
    terminal = _Terminal()
    try:
        text = _run(arguments, terminal)
    except (ValueError, OSError, ImportError, InferenceError) as error:
        terminal.close()
        complain("calibrate", error)
        return 1
    except KeyboardInterrupt:
        terminal.close()
        complain("calibrate", "interrupted; nothing was written")
        return 130
    return write_output("calibrate", text)


def report(calibration: Calibration, path: Path, unknown: str = "") -> str:
    """Summary for the user; `unknown`: why the loss of mAP is unknown, or ""."""
    lines = [
        f"{'':24}{'ms per image':>14}{'processor ms':>14}{'agreement F1':>14}{'box IoU':>10}{'mAP loss':>10}"
    ]
    for each in calibration.measured:
        name = f"{each.precision} in {each.runtime}"
        loss = "" if each.map_loss is None else f"{each.map_loss:10.2f}"
        times = f"{each.ms_per_image:14.1f}{each.processor_ms_per_image:14.1f}"
        lines.append(f"{name:24}{times}{each.agreement_f1:14.3f}{each.box_iou:10.3f}{loss}")
    layers, kept = len(calibration.ranges), len(calibration.fp32_layers)
    return "\n".join(
        (
            *lines,
            f"images      {calibration.images}; {calibration.detections} detections of fp32 were compared",
            f"layers      {layers - kept} in int8, {kept} and the last one in fp32",
            f"mAP loss    {_loss(unknown)}",
            f"processor   {calibration.processor}: {', '.join(calibration.abilities)}",
            f"written     {in_one_line(str(path), _MAX_PATH)}",
            verdict(calibration),
            "",
        )
    )


def _loss(unknown: str) -> str:
    if unknown:
        return f"unknown: {in_one_line(unknown, _MAX_PATH)}"
    return f"points of mAP@50:95 that int8 loses against fp32 in {COARSE_RUNTIME}, by the labels"


def verdict(calibration: Calibration) -> str:
    """Which precision `auto` uses on this computer, and why."""
    if problem := quality_problem(calibration, image_size=calibration.image_size):
        return f"precision auto uses fp32 because {problem}"
    choice = choice_of(calibration)
    return f"precision auto uses {choice.precision} because {choice.reason}"


def _run(arguments: argparse.Namespace, terminal: _Terminal) -> str:
    """Write the calibration and return the summary."""
    if COARSE_RUNTIME not in installed_runtimes():
        raise RuntimeAbsentError(
            f"int8 runs in OpenVINO, which is not installed. Install it with {sys.executable} -m pip install "
            "openvino onnx"
        )
    if not arguments.data.exists():
        raise FileNotFoundError(f"{arguments.data}: file or folder not found")
    weights = load_weights(arguments.weights)
    path: Path = arguments.output or path_beside(weights.path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: folder not found; create it first")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected a file to write, found a folder")
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"{path.parent}: not writable; choose another folder with -o")
    settings = _settings(arguments)
    problems = Problems(terminal.remark)
    stride = size_multiple(weights.model.architecture)
    check_image_size(arguments.image_size, stride)
    checked_cost(weights.model.architecture, arguments.image_size, images=SENSITIVITY_FRAMES)
    data = _data(arguments, stride, problems, terminal)
    loss = MapLoss(data.labelled, weights, settings, watch=terminal, problems=problems)
    if data.labelled is not None and loss.unknown:
        terminal.remark(f"the labels are not used: {loss.unknown}")
    calibration = Calibrating(
        weights,
        data.images,
        image_size=arguments.image_size,
        selection=Selection(
            confidence_threshold=arguments.confidence_threshold, iou_threshold=arguments.iou_threshold
        ),
        tell=terminal.tell,
        map_loss=loss,
    ).result()
    write_calibration(path, calibration)
    terminal.close()
    return report(calibration, path, loss.unknown)


def _settings(arguments: argparse.Namespace) -> Settings:
    """The settings with which labelled images are evaluated."""
    return validated(
        {
            "image_size": arguments.image_size,
            "confidence_threshold": arguments.confidence_threshold,
            "iou_threshold": arguments.iou_threshold,
        }
    )


def _data(
    arguments: argparse.Namespace, stride: int, problems: Problems, terminal: _Terminal
) -> CalibrationData:
    return read_calibration_data(
        arguments.data,
        DataOptions(split=arguments.split, root=arguments.root, topic=arguments.topic),
        arguments.images,
        functools.partial(fitted, image_size=arguments.image_size, stride=stride),
        problems=problems,
        lost=lambda label, error: terminal.lost(label, Outcome.REJECTED, error),
        seen=lambda count: terminal.tell(f"reading: {count} images"),
    )


class _Terminal:
    """Progress, and the first images that cannot be read, on stderr."""

    def __init__(self) -> None:
        self._lost = 0
        self._is_line_open = False

    def tell(self, text: str) -> None:
        show_progress(text)
        self._is_line_open = True

    def progress(self, account: Account) -> None:
        self.tell(f"evaluating: {account.balance.received} of {account.expected} images")

    def remark(self, text: str) -> None:
        self.close()
        complain("calibrate", text)

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        self._lost += 1
        if self._lost <= _MAX_TOLD:
            self.remark(f"{label}: left out: {error}")
        if self._lost == _MAX_TOLD:
            complain("calibrate", "further problems are only counted")

    def close(self) -> None:
        """End the progress line."""
        if self._is_line_open:
            show_progress("", done=True)
        self._is_line_open = False
