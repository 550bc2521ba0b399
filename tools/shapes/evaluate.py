"""How well a model finds shapes: `python -m tools.shapes.evaluate weights/shapes.safetensors`."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.shapes.random_shapes import LabelledImage, frame, still
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene, Truth
from yolov5_lifecycle.tracking.assignment import iou_matrix

UNSEEN_SEED = 999_331
"""Training seeds its generators with pairs of integers, so no single integer repeats a training image."""
IMAGES = 300
_SMALLEST_IOU = 0.5


@dataclass(frozen=True)
class Tally:
    """Detections and ground truth of many images, matched one to one within each class at IoU >= 0.5.

    `scores` (n,), `class_ids` and `mask_ious` describe the true positives; `wrong` counts false positives,
    `missed` false negatives.
    """

    scores: NDArray[np.float32]
    class_ids: NDArray[np.int64]
    mask_ious: NDArray[np.float32]
    """Intersection over union of found and true pixels; (0,) if the model does not segment."""
    wrong: int
    missed: int

    @property
    def precision(self) -> float:
        """Share of the detections that are correct; 1 without detections."""
        return _share(len(self.scores), self.wrong)

    @property
    def recall(self) -> float:
        """Share of the ground truth shapes that were detected; 1 without shapes."""
        return _share(len(self.scores), self.missed)


def tally(answers: Iterable[tuple[Detections, LabelledImage]]) -> Tally:
    """Compare detections with the ground truth of their images."""
    scores: list[float] = []
    class_ids: list[int] = []
    ious: list[float] = []
    wrong = missed = 0
    for detections, image in answers:
        pairs = matched(detections, image.truth)
        right = [row for row, _ in pairs]
        scores += detections.scores[right].tolist()
        class_ids += detections.class_ids[right].tolist()
        ious += mask_ious(detections, image.labels, pairs)
        wrong += len(detections) - len(right)
        missed += len(image.truth.class_ids) - len(right)
    return Tally(
        scores=np.array(scores, np.float32),
        class_ids=np.array(class_ids, np.int64),
        mask_ious=np.array(ious, np.float32),
        wrong=wrong,
        missed=missed,
    )


def matched(detections: Detections, truth: Truth) -> list[tuple[int, int]]:
    """Rows of `detections`, best first, with the shape of the truth that no better one matches."""
    pairs = []
    unfound = iou_matrix(detections.boxes_xyxy, truth.boxes_xyxy)
    unfound[detections.class_ids[:, None] != truth.class_ids] = 0
    for row in range(len(unfound)):
        if unfound.shape[1] and unfound[row].max() >= _SMALLEST_IOU:
            shape = int(unfound[row].argmax())
            unfound[:, shape] = 0
            pairs.append((row, shape))
    return pairs


def mask_ious(
    detections: Detections, labels: NDArray[np.uint16], pairs: Iterable[tuple[int, int]]
) -> list[float]:
    """Intersection over union of the mask of each matched detection and its shape; [] without masks."""
    if detections.masks is None:
        return []
    ious = []
    for row, shape in pairs:
        window, mask = detections.masks.inside_box(row, detections.boxes_xyxy[row])
        is_shape = labels == shape + 1
        shared = (mask & is_shape[window.rows, window.columns]).sum()
        ious.append(float(shared / (mask.sum() + is_shape.sum() - shared)))
    return ious


def evaluate(detector: Detector, images: Iterable[LabelledImage]) -> Tally:
    """Run `detector` with the default thresholds on images with known ground truth."""
    selection = Selection(with_masks=True)
    return tally((detector.detect(ColourImage(image.pixels, "rgb"), selection), image) for image in images)


def stills(seed: int, count: int, size_hw: tuple[int, int]) -> Iterator[LabelledImage]:
    """`count` random scenes."""
    rng = np.random.default_rng(seed)
    return (still(rng, size_hw) for _ in range(count))


def moving(seed: int, count: int, size_hw: tuple[int, int]) -> Iterator[LabelledImage]:
    """One frame each of `count` moving scenes."""
    return (frame(Scene(seed + number, size_hw), 37 * number) for number in range(count))


def _share(right: int, other: int) -> float:
    return right / (right + other) if right + other else 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--seed", type=int, default=UNSEEN_SEED)
    arguments = parser.parse_args()
    model = load_weights(arguments.weights).model
    heads = ["images", "image_size", "precision", "recall", "circles with score > 0.6"]
    if model.architecture.mask_coefficients:
        heads.append("mask IoU")
    print(_row(heads), _row(["---"] * len(heads)), sep="\n")
    for kind, images, size_hw, image_size in (
        ("stills", stills, (256, 320), 320),
        ("stills", stills, (480, 640), 640),
        ("moving", moving, (480, 640), 640),
        ("moving", moving, (480, 640), 320),
        ("moving", moving, (240, 320), 320),
    ):
        detector = load_detector(model, image_size=image_size)
        result = evaluate(detector, images(arguments.seed, IMAGES, size_hw))
        circles = result.scores[result.class_ids == CLASS_NAMES.index("circle")]
        sure = float((circles > 0.6).mean()) if len(circles) else 0.0
        figures = [result.precision, result.recall, sure]
        if len(result.mask_ious):
            figures.append(float(result.mask_ious.mean()))
        name = f"{kind} {size_hw[1]}x{size_hw[0]}"
        print(_row([name, str(image_size), *(f"{figure:.4f}" for figure in figures)]))


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
