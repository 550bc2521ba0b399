"""A data set of shapes in YOLO format: `python -m tools.shapes.dataset OUT --images 40`."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from tools.shapes.evaluate import UNSEEN_SEED
from tools.shapes.images import spoilt_scene
from tools.shapes.random_shapes import LabelledImage
from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.sources.scene import CLASS_NAMES

SIZE_HW = (256, 320)


def labelled_images(seed: int, count: int) -> list[LabelledImage]:
    """`count` scenes not seen in training, degraded like the training images."""
    rng = np.random.default_rng(seed)
    return [spoilt_scene(rng, SIZE_HW) for _ in range(count)]


def write_dataset(folder: Path, *, images: int, seed: int = UNSEEN_SEED) -> None:
    """Write `images/val`, `labels/val` and `data.yaml` to the new `folder`.

    Raises OutputError if it exists, and OSError.
    """
    with whole_output(folder) as unfinished:
        for name in ("images", "labels"):
            (unfinished / name / "val").mkdir(parents=True)
        names = "".join(f"  {number}: {name}\n" for number, name in enumerate(CLASS_NAMES))
        (unfinished / "data.yaml").write_text(f"path: .\nval: images/val\nnames:\n{names}")
        for number, image in enumerate(labelled_images(seed, images)):
            pixels = np.ascontiguousarray(image.pixels[..., ::-1])
            cv2.imwrite(
                str(unfinished / "images" / "val" / f"{number:04}.jpg"),
                pixels,
                (cv2.IMWRITE_JPEG_QUALITY, 92),
            )
            (unfinished / "labels" / "val" / f"{number:04}.txt").write_text(label_lines(image))


def label_lines(image: LabelledImage) -> str:
    """The ground truth in YOLO format: class, centre and size of each box in fractions of the image."""
    height, width = image.pixels.shape[:2]
    boxes = image.truth.boxes_xyxy / np.array((width, height, width, height))
    lines = []
    for class_id, (x1, y1, x2, y2) in zip(image.truth.class_ids.tolist(), boxes.tolist(), strict=True):
        cxcywh = ((x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1)
        lines.append(f"{class_id} {' '.join(f'{value:.6f}' for value in cxcywh)}\n")
    return "".join(lines)


def parser() -> argparse.ArgumentParser:
    """The argument parser of this program."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, metavar="OUT", help="new folder")
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--seed", type=int, default=UNSEEN_SEED)
    return parser


def main() -> None:
    arguments = parser().parse_args()
    write_dataset(arguments.out, images=arguments.images, seed=arguments.seed)


if __name__ == "__main__":
    main()
