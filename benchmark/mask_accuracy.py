"""How many pixels of an object differ from YOLOv5's `process_mask_native`, on unseen scenes of the shapes.

PYTHONPATH=test python -m benchmark.mask_accuracy [--images 40]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from support.reference_masks import reference_mask, whole_mask

from benchmark.report import Figures, Program, row
from tools.shapes.evaluate import UNSEEN_SEED, moving, stills
from tools.shapes.labelled_image import LabelledImage
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ColourImage

WEIGHTS = Path(__file__).parents[1] / "weights" / "shapes-seg.safetensors"
Images = Callable[[int, int, tuple[int, int]], Iterable[LabelledImage]]
"""From a seed, a number and a size."""
SCENES: tuple[tuple[str, Images, tuple[int, int], int], ...] = (
    ("stills 640x480", stills, (480, 640), 640),
    ("stills 700x500", stills, (500, 700), 640),
    ("moving 640x480", moving, (480, 640), 320),
    ("moving 1920x1080", moving, (1080, 1920), 640),
)
"""Name, images, their size and `image_size`."""
EXACT = "the same boxes"
MAPPED = "boxes as YOLOv5 maps them back"
ROUNDED = "these boxes, rounded to pixels"


def boxes_of_yolov5(boxes_xyxy: NDArray[np.float32], letterbox: Letterbox) -> NDArray[np.float32]:
    """Boxes (n, 4) in pixels of the image, mapped back with an unrounded scale and padding as YOLOv5 does.

    `boxes_xyxy` (n, 4) are those of `letterbox`, which rounds both.
    """
    network_hw, source_hw = np.array(letterbox.network_hw), np.array(letterbox.source_hw)
    resized_wh = np.array(letterbox.resized_hw[::-1] * 2) / np.array(letterbox.source_hw[::-1] * 2)
    in_network = boxes_xyxy * resized_wh + np.array((letterbox.left, letterbox.top) * 2)
    scale = (network_hw / source_hw).min()
    padding_wh = ((network_hw - source_hw * scale) / 2)[::-1]
    mapped = (in_network - np.tile(padding_wh, 2)) / scale
    return np.asarray(np.clip(mapped, 0, np.tile(source_hw[::-1], 2)), np.float32)


def different_shares(detections: Detections, boxes_xyxy: NDArray[np.float32]) -> list[float]:
    """For each detection, different pixels per pixel of the reference, which is cut off at `boxes_xyxy`."""
    if detections.masks is None:
        raise ValueError("expected a model that segments")
    shares = []
    for number, box_xyxy in enumerate(boxes_xyxy):
        found = whole_mask(detections.masks, number, detections.boxes_xyxy[number])
        wanted = reference_mask(detections.masks, number, box_xyxy) > 0.5
        if wanted.any():
            shares.append(float((found != wanted).sum() / wanted.sum()))
    return shares


def compared(detector: Detector, images: Iterable[LabelledImage]) -> dict[str, list[float]]:
    """The shares of different pixels in `images`, by the boxes of the reference."""
    shares: dict[str, list[float]] = {EXACT: [], MAPPED: [], ROUNDED: []}
    for image in images:
        detections = detector.detect(ColourImage(image.pixels, "rgb"), Selection(with_masks=True))
        size_hw = (image.pixels.shape[0], image.pixels.shape[1])
        letterbox = Letterbox.fit(size_hw, image_size=detector.image_size, stride=detector.stride)
        mapped = boxes_of_yolov5(detections.boxes_xyxy, letterbox)
        shares[EXACT] += different_shares(detections, detections.boxes_xyxy)
        shares[MAPPED] += different_shares(detections, mapped)
        shares[ROUNDED] += different_shares(detections, np.round(mapped))
    return shares


def measured(options: argparse.Namespace, _: Path) -> Figures:
    """Percent of the pixels, for all images and boxes."""
    model, rows = load_weights(WEIGHTS).model, []
    for name, images, size_hw, image_size in SCENES:
        detector = load_detector(model, device="cpu", image_size=image_size)
        for boxes, shares in compared(detector, images(UNSEEN_SEED, options.images, size_hw)).items():
            percents = [100 * share for share in shares]
            what = f"{name}, {image_size}, {len(shares)} objects"
            rows.append(row(what, boxes, 0, percents, unit="%"))
            rows.append(row(what, f"{boxes}: worst", 0, [max(percents)], unit="%"))
    return rows, []


PROGRAM = Program(
    "mask_accuracy", __doc__, measured, {"--images": {"type": int, "default": 40, "help": "of each kind"}}
)
parser = PROGRAM.parser


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
