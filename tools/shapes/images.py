"""Training images: synthetic scenes, degraded like images from real cameras and transports."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from tools.shapes.random_shapes import LabelledImage, random_shapes, still
from yolov5_lifecycle.detection.letterbox import PADDING_VALUE
from yolov5_lifecycle.sources.scene import Truth, label_image, truth_of

MASK_CELL_PX = 4
"""Side of a cell of the prototypes: half the stride of the finest level."""

# (height, width) of the images of a batch, batch size and probability; all batches cost about the same.
_BATCHES = (((256, 320), 16, 0.75), ((192, 256), 27, 0.05), ((480, 640), 4, 0.2))


@dataclass(frozen=True)
class Batch:
    """Images of one size and their ground truth."""

    pixels: Tensor
    """uint8 (B, 3, H, W), RGB."""
    targets: Tensor
    """float32 (n, 6): image index, class, cx, cy, w, h in pixels."""
    masks: Tensor
    """float32 (n, H / MASK_CELL_PX, W / MASK_CELL_PX): the share of each cell that belongs to the target."""


class Batches(Dataset[Batch]):
    """Batch number i is a pure function of (seed, i)."""

    def __init__(self, seed: int, count: int) -> None:
        self.seed = seed
        self.count = count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Batch:
        rng = np.random.default_rng((self.seed, index))
        size_hw, count, _ = _BATCHES[rng.choice(len(_BATCHES), p=[share for *_, share in _BATCHES])]
        images = [spoilt_scene(rng, size_hw) for _ in range(count)]
        pixels = np.stack([image.pixels for image in images]).transpose(0, 3, 1, 2)
        targets = [_targets(number, image.truth) for number, image in enumerate(images)]
        masks = [covered_shares(image.labels, len(image.truth.class_ids)) for image in images]
        return Batch(
            pixels=torch.from_numpy(np.ascontiguousarray(pixels)),
            targets=torch.from_numpy(np.concatenate(targets)),
            masks=torch.from_numpy(np.concatenate(masks)),
        )


def spoilt_scene(rng: np.random.Generator, size_hw: tuple[int, int]) -> LabelledImage:
    """A random scene as delivered by a camera and processed by the letterbox."""
    make = _shrunk_scene if rng.random() < 0.2 else still
    image = make(rng, size_hw)
    return replace(image, pixels=spoil(rng, image.pixels))


def spoil(rng: np.random.Generator, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Random desaturation, lighting, blur, noise and JPEG artefacts; does not modify `pixels` (H, W, 3)."""
    if rng.random() < 0.3:
        grey = cv2.cvtColor(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
        colour = rng.uniform(0.2, 1.0)
        pixels = cv2.addWeighted(pixels, colour, grey, 1 - colour, 0)
    if rng.random() < 0.5:
        gain = rng.uniform(0.5, 1.2)
        pixels = cv2.convertScaleAbs(pixels, alpha=gain, beta=rng.uniform(0, 255 * max(1 - gain, 0)))
    if rng.random() < 0.3:
        pixels = cv2.GaussianBlur(pixels, (0, 0), rng.uniform(0.4, 1.2))
    if rng.random() < 0.4:
        noise = np.empty(pixels.shape, np.int16)
        cv2.setRNGSeed(int(rng.integers(0, 2**31)))
        cv2.randn(noise, 0, rng.uniform(2, 18))
        pixels = cv2.add(pixels, noise, dtype=cv2.CV_8U)
    if rng.random() < 0.15:
        _, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))])
        pixels = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    return pixels


def covered_shares(labels: NDArray[np.uint16], count: int) -> NDArray[np.float32]:
    """(count, H / MASK_CELL_PX, W / MASK_CELL_PX): the share of each cell that has the label i + 1."""
    height, width = labels.shape
    cells = labels.reshape(height // MASK_CELL_PX, MASK_CELL_PX, width // MASK_CELL_PX, MASK_CELL_PX)
    wanted = np.arange(1, count + 1, dtype=np.uint16)[:, None, None, None, None]
    return np.asarray((cells == wanted).mean(axis=(2, 4)), np.float32)


def _shrunk_scene(rng: np.random.Generator, size_hw: tuple[int, int]) -> LabelledImage:
    """A scene drawn larger, downscaled without smoothing like the letterbox, with bands above and below."""
    height, width = size_hw
    band = int(rng.integers(0, height // 12))
    scale = rng.uniform(1.2, 2.0)
    large_hw = (round((height - 2 * band) * scale), round(width * scale))
    pixels, shapes = random_shapes(rng, large_hw)
    small = cv2.resize(pixels, (width, height - 2 * band), interpolation=cv2.INTER_LINEAR)
    small = cv2.copyMakeBorder(small, band, band, 0, 0, cv2.BORDER_CONSTANT, value=(PADDING_VALUE,) * 3)
    truth = truth_of(shapes, large_hw)
    scale_xy = (width / large_hw[1], (height - 2 * band) / large_hw[0])
    boxes = truth.boxes_xyxy * np.array(scale_xy * 2) + np.array((0, band, 0, band))
    labels = np.zeros(size_hw, np.uint16)
    labels[band : height - band] = label_image(
        [shape.outline() * scale_xy for shape in shapes], (height - 2 * band, width)
    )
    return LabelledImage(
        np.asarray(small, np.uint8), Truth(boxes.astype(np.float32), truth.class_ids), labels
    )


def _targets(number: int, truth: Truth) -> NDArray[np.float32]:
    x1, y1, x2, y2 = truth.boxes_xyxy.T
    numbers = np.full(len(x1), number)
    columns = (numbers, truth.class_ids, (x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1)
    return np.stack(columns, axis=1).astype(np.float32)
