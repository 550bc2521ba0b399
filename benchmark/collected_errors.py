"""Whether collected images show more errors of the model than random ones, on a drive whose truth is known.

python -m benchmark.collected_errors [--seeds 3]
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmark.report import Figures, Goal, Program, row
from tools.shapes.evaluate import matched
from yolov5_lifecycle import Detections, Detector, load_model
from yolov5_lifecycle.collecting.candidate import Candidate, CollectRules, Origin
from yolov5_lifecycle.collecting.collected_files import kept_images
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota
from yolov5_lifecycle.collecting.collector import CameraCollecting, Collector
from yolov5_lifecycle.detection.nms import Selection, narrowed
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene, Truth, cluttered_background
from yolov5_lifecycle.tracking.assignment import iou_matrix

WEIGHTS = Path(__file__).parents[1] / "weights" / "shapes.safetensors"
SIZE_HW = (240, 320)
RATE_HZ = 10.0
PLACES, FRAMES_IN_A_PLACE, FRAMES_OF_A_TURN = 60, 100, 20
KEPT = 200
USUAL = "usual"
_SHARE_OF_WEAK = 0.2
_SHARE_OF_EMPTY = 0.25
"""Of the usual places: a model that finds nothing there is right."""
_DUPLICATE_IOU = 0.97
_VISIBLE = 0.5
"""An object of which less is seen while the camera turns is not expected to be found."""

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class DriveFrame:
    """An image of a drive with its ground truth, and what makes it difficult."""

    number: int
    place: int
    weakness: str
    pixels: Pixels
    truth: Truth


def drive(seed: int) -> Iterator[DriveFrame]:
    """A camera in one place after the other; in some of them the model is weak in a known way."""
    rng = np.random.default_rng(seed)
    count = round(_SHARE_OF_WEAK * PLACES)
    weak = [*_WEAKNESSES] * (count // len(_WEAKNESSES))
    kinds = rng.permutation([*weak, *[USUAL] * (PLACES - len(weak))]).tolist()
    before: tuple[Pixels, Truth] | None = None
    number = 0
    for place, kind in enumerate(kinds):
        seen = _WEAKNESSES.get(kind, _usual)(rng, int(rng.integers(1 << 30)))
        turn = [] if before is None else [*_turn(before, seen(0))]
        views = (*turn, *map(seen, range(FRAMES_IN_A_PLACE)))
        for pixels, truth in views:
            yield DriveFrame(number, place, kind, pixels, truth)
            number += 1
        before = pixels, truth


def _turn(start: tuple[Pixels, Truth], end: tuple[Pixels, Truth]) -> Iterator[tuple[Pixels, Truth]]:
    """What the camera sees while it turns from one place to the next, which is on its right."""
    width = SIZE_HW[1]
    pixels = np.concatenate([start[0], end[0]], axis=1)
    boxes = np.concatenate(
        [start[1].boxes_xyxy, end[1].boxes_xyxy + np.array([width, 0, width, 0], np.float32)]
    )
    class_ids = np.concatenate([start[1].class_ids, end[1].class_ids])
    for x in np.linspace(0, width, FRAMES_OF_A_TURN + 2).astype(int)[1:-1].tolist():
        seen = boxes - np.array([x, 0, x, 0], np.float32)
        inside = np.clip(seen, 0, np.array([width, SIZE_HW[0]] * 2, np.float32))
        shown = (inside[:, 2] - inside[:, 0]) >= _VISIBLE * (seen[:, 2] - seen[:, 0])
        part = np.ascontiguousarray(pixels[:, x : x + width])
        yield part, Truth(inside[shown].astype(np.float32), class_ids[shown])


View = Callable[[int], tuple[Pixels, Truth]]


def _usual(rng: np.random.Generator, seed: int) -> View:
    if rng.random() >= _SHARE_OF_EMPTY:
        return Scene(seed, SIZE_HW).frame
    pixels = cluttered_background(rng, SIZE_HW)
    return lambda index: (pixels.copy(), Truth(np.empty((0, 4), np.float32), np.empty(0, np.int64)))


def _blurred(rng: np.random.Generator, seed: int) -> View:
    scene, sigma = Scene(seed, SIZE_HW), rng.uniform(4, 6)

    def view(index: int) -> tuple[Pixels, Truth]:
        pixels, truth = scene.frame(index)
        return np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma), np.uint8), truth

    return view


def _at_night(rng: np.random.Generator, seed: int) -> View:
    scene, light = Scene(seed, SIZE_HW), rng.uniform(0.04, 0.08)

    def view(index: int) -> tuple[Pixels, Truth]:
        pixels, truth = scene.frame(index)
        noise = np.random.default_rng((seed, index)).normal(0, 6, pixels.shape)
        return np.clip(pixels * light + noise, 0, 255).astype(np.uint8), truth

    return view


def _small(rng: np.random.Generator, seed: int) -> View:
    scene = Scene(seed, (80, 106))
    around = cluttered_background(rng, SIZE_HW)
    x, y = int(rng.integers(SIZE_HW[1] - 106)), int(rng.integers(SIZE_HW[0] - 80))

    def view(index: int) -> tuple[Pixels, Truth]:
        part, truth = scene.frame(index)
        pixels = around.copy()
        pixels[y : y + 80, x : x + 106] = part
        shifted = truth.boxes_xyxy + np.array([x, y, x, y], np.float32)
        return pixels, Truth(shifted, truth.class_ids)

    return view


def _striped(rng: np.random.Generator, seed: int) -> View:
    """Squares have a look that the model has never seen."""
    scene = Scene(seed, SIZE_HW)
    colour = tuple(int(value) for value in rng.integers(0, 255, 3))

    def view(index: int) -> tuple[Pixels, Truth]:
        pixels, truth = scene.frame(index)
        for x1, y1, x2, y2 in truth.boxes_xyxy[truth.class_ids == CLASS_NAMES.index("square")].astype(int):
            for x in range(x1, x2, 6):
                pixels[y1:y2, x : x + 3] = colour
        return pixels, truth

    return view


_WEAKNESSES: dict[str, Callable[[np.random.Generator, int], View]] = {
    "blur": _blurred,
    "night": _at_night,
    "small": _small,
    "new look": _striped,
}


def errors(found: Detections, truth: Truth) -> int:
    """Objects that were missed, found where there is none, or found as another class."""
    return len(truth.class_ids) + len(found) - 2 * len(matched(found, truth))


class _AtOnce(Collector):
    """Decides in the thread that offers: simulated time stands still meanwhile."""

    def offer(self, candidate: Candidate) -> None:
        self.decide(candidate)


@dataclass(frozen=True)
class Outcome:
    """Errors of each image of a drive, and the numbers of the images that were kept."""

    errors: list[int]
    weaknesses: list[str]
    places: list[int]
    truths: list[Truth]
    kept: list[int]

    @property
    def density_ratio(self) -> float:
        """Errors in a kept image / in any image."""
        return statistics.mean(self.errors[number] for number in self.kept) / statistics.mean(self.errors)

    @property
    def found_weaknesses(self) -> Counter[str]:
        return Counter(self.weaknesses[number] for number in self.kept)

    @property
    def duplicates(self) -> float:
        """Share of kept images in which every object is where it is in another one of the same place."""
        return statistics.mean(self._is_duplicate(index) for index in range(len(self.kept)))

    def _is_duplicate(self, index: int) -> bool:
        number = self.kept[index]
        boxes = self.truths[number].boxes_xyxy
        return any(
            self.places[other] == self.places[number]
            and len(boxes) == len(self.truths[other].boxes_xyxy)
            and np.diag(iou_matrix(boxes, self.truths[other].boxes_xyxy)).min(initial=1) >= _DUPLICATE_IOU
            for other in self.kept[:index]
        )


def collect(detector: Detector, seed: int, folder: Path) -> Outcome:
    """Detect in a drive and keep the KEPT most valuable images of it."""
    rules = CollectRules(
        settings=Settings(collect_per_minute=0.0),
        selection=Selection(),
        camera="",
        class_names=detector.class_names,
        segments=False,
        weights_sha256="",
    )
    now_s = [0.0]
    quota = Quota(max_bytes=1 << 40, max_frames=KEPT, min_free_bytes=0)
    collector = _AtOnce(lambda: CollectedFolder(folder, quota), clock=lambda: now_s[0])
    collecting = CameraCollecting(collector, rules, clock=lambda: now_s[0])
    outcome = Outcome([], [], [], [], [])
    for frame in drive(seed):
        now_s[0] = frame.number / RATE_HZ
        image = ColourImage(frame.pixels, "rgb")
        found = detector.detect(image, collecting.wanted(Selection()))
        published = narrowed(found, Selection())
        collecting.look(found, published, image, None, Origin("", 0, frame.number))
        outcome.errors.append(errors(published, frame.truth))
        outcome.weaknesses.append(frame.weakness)
        outcome.places.append(frame.place)
        outcome.truths.append(frame.truth)
    collector.close(0.0)
    kept = [frame.nanosec for _, frame in kept_images(folder)]
    return replace(outcome, kept=kept)


def figures(outcomes: Sequence[Outcome]) -> Figures:
    """What the drives have in common, and the goals for the medians."""
    ratios = [outcome.density_ratio for outcome in outcomes]
    duplicates = [100 * outcome.duplicates for outcome in outcomes]
    rows = [
        row("errors", "an image", 0, [statistics.mean(each.errors) for each in outcomes], unit=""),
        row("errors", "a kept image / an image", 0, ratios, unit="x"),
        row("kept", "near duplicates", 0, duplicates, unit="%"),
    ]
    for kind in (USUAL, *_WEAKNESSES):
        shares = [100 * each.found_weaknesses[kind] / len(each.kept) for each in outcomes]
        rows.append(row("kept", kind, 0, shares, unit="%"))
    found = min(len(each.found_weaknesses.keys() & _WEAKNESSES.keys()) for each in outcomes)
    goals = [
        Goal("errors in a kept image / in an image", 0, statistics.median(ratios), False, 3.0),
        Goal("near duplicates, %", 0, statistics.median(duplicates), True, 5.0),
        Goal(
            f"weaknesses among {KEPT} kept images, of {len(_WEAKNESSES)}", 0, found, False, len(_WEAKNESSES)
        ),
    ]
    return rows, goals


def measured(options: argparse.Namespace, folder: Path) -> Figures:
    """The drives of all seeds."""
    detector = load_model(WEIGHTS, image_size=320, runtime="onnxruntime", precision="fp32")
    with closing(detector):
        return figures([collect(detector, seed, folder / str(seed)) for seed in range(options.seeds)])


PROGRAM = Program(
    "collected_errors",
    __doc__,
    measured,
    {"--seeds": {"type": int, "default": 3, "help": "number of drives"}},
)
parser = PROGRAM.parser


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
