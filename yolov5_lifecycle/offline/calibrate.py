"""Command `calibrate WEIGHTS DATA`: learn how to run a model in int8, and measure whether it pays."""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.detection.detector import check_image_size
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.models.geometry import size_multiple
from yolov5_lifecycle.offline.calibrating import Calibrating
from yolov5_lifecycle.offline.calibration_frames import (
    Source,
    diverse_images,
    fitted,
    of_one_size,
    open_bag,
    open_files,
)
from yolov5_lifecycle.offline.recordings import is_recording
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import complain, show_progress, write_output
from yolov5_lifecycle.quantization.calibration_file import Calibration, path_beside, write_calibration
from yolov5_lifecycle.quantization.precision_choice import MIN_SPEEDUP, quality_problem
from yolov5_lifecycle.runtimes.registry import COARSE_RUNTIME, RuntimeAbsentError, installed_runtimes
from yolov5_lifecycle.runtimes.runtime import InferenceError

_MAX_TOLD = 10
_MAX_PATH = 4096
_LINE = 72
_EPILOG = """\
examples:
  calibrate best.pt drive.mcap
  calibrate best.pt images --image-size 320 --confidence-threshold 0.4

The file lies beside the weights, where the setting `precision` looks for it: int8 uses it, and auto does
if int8 agrees with fp32 and is at least 1.15 times as fast on the computer at hand. See docs/int8.md.
"""


def main(argv: Sequence[str] | None = None) -> int:
    arguments = command_parser().parse_args(argv)
    terminal = _Terminal()
    try:
        calibration, path = _run(arguments, terminal)
    except (ValueError, OSError, ImportError, InferenceError) as error:
        terminal.close()
        complain("calibrate", error)
        return 1
    return write_output("calibrate", report(calibration, path))


def report(calibration: Calibration, path: Path) -> str:
    """What was measured, for the user."""
    lines = [f"{'':24}{'ms per image':>14}{'agreement F1':>14}{'box IoU':>10}"]
    for each in calibration.measured:
        name = f"{each.precision} in {each.runtime}"
        lines.append(f"{name:24}{each.ms_per_image:14.1f}{each.agreement_f1:14.3f}{each.box_iou:10.3f}")
    layers, kept = len(calibration.ranges), len(calibration.fp32_layers)
    return "\n".join(
        (
            *lines,
            f"images      {calibration.images}, with {calibration.detections} detections in fp32 in those "
            "that were compared",
            f"layers      {layers - kept} in int8, {kept} and the last one in fp32",
            f"mAP loss    unknown: {COARSE_RUNTIME} was compared with itself in fp32, not with labels",
            f"processor   {calibration.processor}: {', '.join(calibration.abilities)}",
            f"written     {in_one_line(str(path), _MAX_PATH)}",
            verdict(calibration),
            "",
        )
    )


def verdict(calibration: Calibration) -> str:
    """What `precision: auto` makes of it."""
    if problem := quality_problem(calibration, image_size=calibration.image_size):
        return f"precision auto stays fp32: {problem}"
    fp32_ms = min(each.ms_per_image for each in calibration.measured if each.precision == "fp32")
    int8_ms = min(each.ms_per_image for each in calibration.measured if each.precision == "int8")
    speedup = fp32_ms / int8_ms
    told = f"int8 is {speedup:.2f} x as fast as the fastest fp32 here"
    if speedup < MIN_SPEEDUP:
        return f"{told}, less than {MIN_SPEEDUP:g} x: precision auto stays fp32"
    return f"{told}: precision auto uses it if it is as fast when the model is loaded"


def _run(arguments: argparse.Namespace, terminal: _Terminal) -> tuple[Calibration, Path]:
    if COARSE_RUNTIME not in installed_runtimes():
        raise RuntimeAbsentError(
            f"int8 runs in OpenVINO, which is not installed. Install it with {sys.executable} -m pip install "
            "openvino onnx"
        )
    if not arguments.data.exists():
        raise FileNotFoundError(f"{arguments.data}: there is no such file or folder")
    weights = load_weights(arguments.weights)
    path: Path = arguments.output or path_beside(weights.path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: there is no such folder; make it first")
    stride = size_multiple(weights.model.architecture)
    check_image_size(arguments.image_size, stride)
    fit = functools.partial(fitted, image_size=arguments.image_size, stride=stride)
    images = _images(arguments, fit, terminal)
    calibration = Calibrating(
        weights,
        images,
        image_size=arguments.image_size,
        selection=Selection(
            confidence_threshold=arguments.confidence_threshold, iou_threshold=arguments.iou_threshold
        ),
        tell=terminal.tell,
    ).result()
    write_calibration(path, calibration)
    terminal.close()
    return calibration, path


def _images(
    arguments: argparse.Namespace, fit: functools.partial[ColourImage], terminal: _Terminal
) -> list[ColourImage]:
    """Diverse images of the data, all of one size; raises ValueError without any."""
    if is_recording(arguments.data):
        opened: AbstractContextManager[Source] = open_bag(arguments.data, arguments.topic)
    elif arguments.topic:
        raise ValueError(f"{arguments.data} is no recording; only those have a use for --topic")
    else:
        opened = nullcontext(open_files(arguments.data))
    with opened as source:
        images = diverse_images(
            source,
            arguments.images,
            fit,
            lost=terminal.lost,
            seen=lambda count: terminal.tell(f"reading: {count} images"),
        )
    if not images:
        raise ValueError(f"{arguments.data}: not one image of it can be used")
    return of_one_size(images)


class _Terminal:
    """Progress, and the first images that cannot be read, on stderr."""

    def __init__(self) -> None:
        self._lost = 0
        self._is_line_open = False

    def tell(self, text: str) -> None:
        show_progress(f"{text:<{_LINE}}")
        self._is_line_open = True

    def lost(self, label: str, error: ImageError) -> None:
        self._lost += 1
        if self._lost <= _MAX_TOLD:
            self.close()
            complain("calibrate", f"{label}: left out: {error}")
        if self._lost == _MAX_TOLD:
            complain("calibrate", "further ones are only counted")

    def close(self) -> None:
        """End the progress line."""
        if self._is_line_open:
            show_progress("", done=True)
        self._is_line_open = False


def command_parser() -> argparse.ArgumentParser:
    """The argument parser of the command."""
    parser = CommandParser(
        "calibrate",
        description="Measure on your images how well and how fast a model runs in int8 on this computer.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("weights", type=Path, metavar="WEIGHTS", help="weights file, .pt or .safetensors")
    parser.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="folder of images, a video, or a recording of ros2 bag, such as the camera will see",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="where to write (default: WEIGHTS with .calibration.json as its ending, which is replaced)",
    )
    parser.add_argument("--topic", help="which images of the recording (default: the only ones)")
    parser.add_argument(
        "--images", type=_count, default=200, metavar="N", help="images at most (default: %(default)s)"
    )
    parser.add_argument(
        "--image-size",
        type=int,
        default=640,
        metavar="PIXELS",
        help="longer side of the network input, as in the setting image_size (default: %(default)s)",
    )
    for name, default in (("confidence", 0.25), ("iou", 0.45)):
        parser.add_argument(
            f"--{name}-threshold",
            type=_share,
            default=default,
            metavar="SHARE",
            help="as the setting of this name (default: %(default)s)",
        )
    return parser


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 5 and 1 <= int(text) <= 2000):
        raise argparse.ArgumentTypeError(f"expected 1 to 2000, found {text!r}")
    return int(text)


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 1, found {text!r}")
    return value
