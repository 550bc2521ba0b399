"""Cost of masks of 1, 10 and 50 objects, their message and drawing, and the forward pass of the network.

python -m benchmark.masks [--weights FILE] [--size 640x480] [--quick]
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Header

from benchmark.models import untrained_network
from benchmark.report import Figures, Goal, Program, measured_ms, quick, row, size_hw
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.draw import draw_masks
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.models.architecture import SIZES
from yolov5_lifecycle.ros.messages import image_message

COUNTS = (1, 10, 50)
FORWARD, PROTOTYPES = "network without prototypes", "prototypes"
DRAWING, MESSAGE = "drawing of 10 objects", "message"
_LAYERS = SIZES["n"].layers
SEGMENT_N = dataclasses.replace(
    SIZES["n"], layers=(*_LAYERS[:-1], _LAYERS[-1]._replace(kind="Segment", args=(32, 256)))
)
"""The architecture of yolov5n-seg."""
_MAX_SHARE_OF_FORWARD = 0.25


def calls(weights: Path, size_hw: tuple[int, int]) -> Mapping[str, Callable[[], object]]:
    """What is measured, by name."""
    detector = load_detector(load_weights(weights).model, device="cpu")
    letterbox = Letterbox.fit(size_hw, image_size=detector.image_size, stride=detector.stride)
    rng = np.random.default_rng(1)
    frame = letterbox.apply(rng.integers(0, 256, (*size_hw, 3), np.uint8))
    compute_prototypes = detector.runtime(frame, "bgr").compute_prototypes
    if compute_prototypes is None:
        raise ValueError(f"{weights}: expected a model that segments")
    prototypes = compute_prototypes()

    def masks_of(count: int) -> Callable[[], NDArray[np.uint16]]:
        boxes_xyxy = random_boxes(rng, count, size_hw)
        coefficients = rng.normal(size=(count, len(prototypes))).astype(np.float32)
        return lambda: Masks.in_image(prototypes, coefficients, size_hw).label_image(boxes_xyxy)

    labels, canvas = masks_of(10)(), np.zeros((*size_hw, 3), np.uint8)
    return {
        FORWARD: lambda: detector.runtime(frame, "bgr", Selection().min_objectness),
        PROTOTYPES: compute_prototypes,
        **{of_objects(count): masks_of(count) for count in COUNTS},
        DRAWING: lambda: draw_masks(canvas, labels, [(255, 0, 0)] * 10),
        MESSAGE: lambda: image_message(labels, "16UC1", Header()),
    }


def of_objects(count: int) -> str:
    return f"masks of {count} object{'s'[: count > 1]}"


def random_boxes(rng: np.random.Generator, count: int, size_hw: tuple[int, int]) -> NDArray[np.float32]:
    """Boxes (n, 4) with sides of 5 to 50 % of those of the image."""
    sides = rng.uniform(0.05, 0.5, (count, 2))
    corners = rng.uniform(0, 1 - sides)
    boxes = np.concatenate((corners, corners + sides), axis=1) * np.array(size_hw[::-1] * 2)
    return np.asarray(boxes, np.float32)


def goal(taken_ms: Mapping[str, Sequence[float]]) -> Goal:
    """Masks of ten objects beside the forward pass of the whole network."""
    medians_ms = {name: statistics.median(times_ms) for name, times_ms in taken_ms.items()}
    share = medians_ms[of_objects(10)] / (medians_ms[FORWARD] + medians_ms[PROTOTYPES])
    return Goal("masks of 10 objects / forward", 0, share, True, _MAX_SHARE_OF_FORWARD)


def measured(options: argparse.Namespace, folder: Path) -> Figures:
    """All calls."""
    weights = options.weights or untrained_network(SEGMENT_N, folder / "untrained.safetensors")
    taken_ms = measured_ms(calls(weights, options.size), turns=20 if options.quick else 200)
    return [row("masks", name, 0, times_ms) for name, times_ms in taken_ms.items()], [goal(taken_ms)]


PROGRAM = Program(
    "masks",
    __doc__,
    measured,
    {
        "--quick": quick("fewer rounds"),
        "--weights": {"type": Path, "help": "if not an untrained yolov5n-seg"},
        "--size": {"type": size_hw, "default": "640x480", "help": "width x height of the image"},
    },
)


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
