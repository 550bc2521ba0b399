"""Command `calibrate WEIGHTS DATA`: learn how to run a model in int8, and measure whether it pays."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detector import check_image_size
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.cost import checked_cost, size_multiple
from yolov5_lifecycle.offline.calibrate.arguments import command_parser
from yolov5_lifecycle.offline.calibrate.calibration_images import fitted, read_calibration_images
from yolov5_lifecycle.offline.calibrate.measuring import SENSITIVITY_FRAMES, Calibrating, Worth
from yolov5_lifecycle.offline.terminal import Terminal, exit_code
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import write_output
from yolov5_lifecycle.quantization.calibration_file import Calibration, path_beside, write_calibration
from yolov5_lifecycle.runtimes.processor import abilities
from yolov5_lifecycle.runtimes.registry import COARSE_RUNTIME, installed_runtimes
from yolov5_lifecycle.runtimes.torch_device import DeviceError
from yolov5_lifecycle.settings.settings import validated
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_COMMAND = "calibrate"
_MAX_IMAGES = 200
_MAX_PATH = 4096


def main(argv: Sequence[str] | None = None) -> int:
    arguments = command_parser().parse_args(argv)

    def run() -> int:
        with closing(Terminal(_COMMAND, shows_progress=True)) as terminal:
            return write_output(_COMMAND, _calibrated(arguments, terminal))

    return exit_code(_COMMAND, run)


def report(calibration: Calibration, worth: Worth, path: Path) -> str:
    """Summary for the user."""
    lines = [f"{'':24}{'ms per image':>14}{'processor ms':>14}{'agreement F1':>14}"]
    for each in worth.measured:
        times = f"{each.taken.wall_ms:14.1f}{each.taken.processor_ms:14.1f}"
        name = f"{each.precision} in {each.runtime}"
        lines.append(f"{name:24}{times}{each.f1:14.3f}")
    layers, kept = len(calibration.ranges), len(calibration.fp32_layers)
    return "\n".join(
        (
            *lines,
            f"detections  {worth.detections} of fp32 were compared",
            f"layers      {layers - kept} in int8, {kept} and the last one in fp32",
            f"processor   {', '.join(abilities())}",
            f"written     {in_one_line(str(path), _MAX_PATH)}",
            worth.verdict(calibration.image_size),
            "",
        )
    )


def _calibrated(arguments: argparse.Namespace, terminal: Terminal) -> str:
    """Write the calibration and return the summary."""
    if COARSE_RUNTIME not in installed_runtimes():
        raise DeviceError(
            f"int8 runs in OpenVINO, which is not installed. Install it with {sys.executable} -m pip install "
            "openvino onnx"
        )
    names = ("image_size", "confidence_threshold")
    settings = validated({name: getattr(arguments, name) for name in names})
    if not arguments.data.exists():
        raise FileNotFoundError(f"{arguments.data}: file or folder not found")
    weights = load_weights(arguments.weights)
    path = path_beside(weights.path)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected a file to write, found a folder; remove it")
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"{path.parent}: not writable; copy the weights into a folder of yours")
    images = _images(arguments, weights.model.architecture, terminal)
    selection = Selection(confidence_threshold=settings.confidence_threshold)
    calibrating = Calibrating(weights.model, images, selection=selection, tell=terminal.begin)
    quantization = calibrating.quantization()
    worth = calibrating.worth(quantization)
    calibration = Calibration(
        **dict(quantization), weights_sha256=weights.sha256, image_size=settings.image_size
    )
    write_calibration(path, calibration)
    return report(calibration, worth, path)


def _images(
    arguments: argparse.Namespace, architecture: Architecture, terminal: Terminal
) -> list[ColourImage]:
    """The images as the network receives them; raises ValueError for a size that it does not take."""
    stride = size_multiple(architecture)
    check_image_size(arguments.image_size, stride)
    checked_cost(architecture, arguments.image_size, images=SENSITIVITY_FRAMES)
    return read_calibration_images(
        arguments.data,
        arguments.topic,
        _MAX_IMAGES,
        partial(fitted, image_size=arguments.image_size, stride=stride),
        lost=lambda label, error: terminal.lost(label, Outcome.REJECTED, error),
        seen=lambda count: terminal.begin(f"reading: {count} images"),
    )
