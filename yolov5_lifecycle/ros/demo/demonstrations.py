"""One camera, then two on one detector: what is demonstrated, and compared with the ground truth."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image, PointCloud2
from vision_msgs.msg import Detection2DArray, Detection3DArray

from yolov5_lifecycle.printable import shell_command
from yolov5_lifecycle.ros.demo.stage import CONFIG, DETECTOR, Commands, Received, Stage, saved
from yolov5_lifecycle.ros.messages import points_of_cloud
from yolov5_lifecycle.tracking.assignment import iou_matrix

MATCHING_IOU = 0.5
SEED = 8
_CAMERA = f"camera --ros-args -p depth:=true -r __node:={{0}} -r image_raw:={DETECTOR}/{{0}}/image_raw"
ONE_CAMERA: Commands = {
    "camera": f"camera --ros-args -p seed:={SEED} -r image_raw:={DETECTOR}/image_raw",
    "detector": f"detector --ros-args --params-file {shell_command(f'{CONFIG}/demo.yaml')}",
}
TWO_CAMERAS: Commands = {
    "front camera": f"{_CAMERA} -p seed:=6 -p width:=480 -p height:=360 -p rate:=15.0".format("front"),
    "rear camera": f"{_CAMERA} -p seed:=29 -p width:=400 -p height:=300 -p rate:=12.0".format("rear"),
    "detector": f"detector --ros-args --params-file {shell_command(f'{CONFIG}/demo_cameras.yaml')}",
}
_FOUND, _TRUTH = f"{DETECTOR}/detections", "/camera/truth"
_MASKS, _TRUE_MASKS = f"{DETECTOR}/masks", "/camera/ground_truth_masks"
NEAR_M = 0.05
_PX_PER_M = 90
_NOWHERE = np.full(3, np.inf)
_TITLE_PX, _GAP_PX = 28, 8
_PAPER, _INK = (255, 255, 255), (40, 40, 40)


def one_camera(stage: Stage) -> str:
    """Every transition, a live change and a model swap; boxes and masks compared with the truth.

    Saves an image and returns a summary. Raises DemonstrationError, TimeoutError or OSError.
    """
    truths = stage.collect(Detection2DArray, _TRUTH)
    found = stage.collect(Detection2DArray, _FOUND)
    stage.transition("configure")
    stage.transition("activate")
    summary = f"{_watch(stage, truths, found, 120)}, {_compare_masks(stage, truths, found)}"
    path = saved(stage.annotated_image(f"{DETECTOR}/image", found), "annotated.png")
    _narrow(stage, found)
    _swap(stage, truths, found)
    _stop(stage, found)
    stage.transition("activate")
    _watch(stage, truths, found, 30)
    _stop(stage, found)
    stage.transition("cleanup")
    return f"{summary}, image in {path}"


def _watch(stage: Stage, truths: Received, found: Received, count: int) -> str:
    frames = stage.frames(count, truths, found)
    right = sum(len(matched(true, seen)) for true, seen in frames.values())
    recall = right / sum(len(true.detections) for true, _ in frames.values())
    latency_ms = statistics.median(stage.latencies_ms[_FOUND, stamp] for stamp in frames)
    told = f"{recall:.1%} of the shapes found in {len(frames)} images, median latency {latency_ms:.0f} ms"
    stage.check(recall >= 0.9, told, "at least 90 %")
    return told


def _compare_masks(stage: Stage, truths: Received, found: Received) -> str:
    true_masks, masks = stage.collect(Image, _TRUE_MASKS), stage.collect(Image, _MASKS)
    frames = stage.frames(20, truths, found, true_masks, masks)
    stage.release(_MASKS, _TRUE_MASKS)
    ious = [iou for true, seen, *both in frames.values() for iou in mask_ious(matched(true, seen), *both)]
    mean = statistics.fmean(ious or [0.0])
    stage.check(mean >= 0.8, told := f"mask IoU {mean:.2f}", "at least 0.8")
    return told


def _narrow(stage: Stage, found: Received) -> None:
    before = stage.node.parameter("confidence_threshold")
    stage.set(confidence_threshold=0.6, classes=["circle"])
    frames = stage.frames(30, found)
    best = [one.results[0].hypothesis for (seen,) in frames.values() for one in seen.detections]
    names = sorted({one.class_id for one in best})
    lowest = min((one.score for one in best), default=0.0)
    told = f"{len(frames)} images show {' and '.join(names) or 'nothing'}, with scores from {lowest:.2f} on"
    stage.check(names == ["circle"] and lowest >= 0.6, told, "only circles, from 0.6 on")
    stage.set(confidence_threshold=before, classes=[])


def _swap(stage: Stage, truths: Received, found: Received) -> None:
    """Change the image size, which loads another model while the current one runs."""
    begun_ns = time.time_ns()
    stage.set(image_size=416)
    taken_s = (time.time_ns() - begun_ns) / 1e9
    _watch(stage, truths, found, 30)
    gap_s = max(np.diff([stamp for stamp in found if stamp > begun_ns - 1_000_000_000])) / 1e9
    told = f"model swapped in {taken_s:.1f} s, longest time without detections {gap_s:.2f} s"
    # Longer only if it waited for the preparation.
    stage.check(bool(gap_s <= max(2.0, taken_s)), told, "at most 2 s")


def _stop(stage: Stage, found: Received) -> None:
    stage.transition("deactivate")
    answered_ns = time.time_ns()
    stage.observer.work_for(1.5)
    late = sum(stamp > answered_ns for stamp in found)
    stage.check(late == 0, f"{late} detections in images of the next 1.5 s", "none")


def two_cameras(stage: Stage) -> str:
    """Two cameras on one detector: detections, tracks and places in space, compared with the truth.

    Saves an image and returns a summary. Raises DemonstrationError, TimeoutError or OSError.
    """
    records = {
        name: (
            stage.collect(Detection2DArray, f"/{name}/truth"),
            stage.collect(Detection3DArray, f"/{name}/ground_truth_3d"),
            stage.collect(Detection2DArray, f"{DETECTOR}/{name}/detections"),
            stage.collect(Detection3DArray, f"{DETECTOR}/{name}/detections_3d"),
            stage.collect(PointCloud2, f"{DETECTOR}/{name}/points"),
        )
        for name in ("front", "rear")
    }
    stage.transition("configure")
    stage.transition("activate")
    stage.report("watching 100 images of each camera")
    known = {name: stage.frames(100, *record, since_ns=0) for name, record in records.items()}
    frames = [(name, *each) for name, of_one in known.items() for each in of_one.values()]
    recall, switches, error = figures([frame[:5] for frame in frames])
    near = points_near([frame[1:] for frame in frames])
    stage.check(recall >= 0.9, f"{recall:.1%} of the shapes found", "at least 90 %")
    stage.check(switches == 0, f"{switches} identity switches", "none")
    stage.check(error <= 0.02, f"median error in space {error:.2%}", "at most 2 %")
    stage.check(near >= 0.95, f"{near:.1%} of the points at their shapes", "at least 95 %")
    images = {
        name: stage.annotated_image(f"{DETECTOR}/{name}/image", places)
        for name, (_, _, _, places, _) in records.items()
    }
    for name, (*_, clouds) in records.items():
        images[f"{name} from above"] = from_above(max(clouds.values(), key=lambda cloud: int(cloud.width)))
    path = saved(side_by_side(images), "cameras.png")
    stage.transition("deactivate")
    stage.transition("cleanup")
    return f"{len(frames)} images of {len(records)} cameras compared, image in {path}"


def figures(frames: Sequence[tuple[Any, ...]]) -> tuple[float, int, float]:
    """Share of the objects that are found, tracks too many or shared, and the median error in space.

    `frames` are names of cameras, each with what is there in an image and in space, and what is found,
    likewise. The error is that of the place, as a share of its distance; infinite for an object that has an
    id and no place.
    """
    true = sum(len(truth.detections) for _, truth, _, _, _ in frames)
    found, tracked, errors = 0, set[tuple[str, str, str]](), []
    for camera, truth, true_places, seen, places in frames:
        true_xyz, xyz = _centres_by_id(true_places), _centres_by_id(places)
        for true_row, row in matched(truth, seen):
            found += 1
            name, track = truth.detections[true_row].id, seen.detections[row].id
            if track:
                tracked.add((camera, name, track))
                error = np.linalg.norm(xyz.get(track, _NOWHERE) - true_xyz[name])
                errors.append(float(error / np.linalg.norm(true_xyz[name])))
    objects, tracks = {(camera, name) for camera, name, _ in tracked}, {track for *_, track in tracked}
    switches = len(tracked) - min(len(objects), len(tracks))
    return found / max(true, 1), switches, float(np.median(errors or [np.inf]))


def points_near(frames: Sequence[tuple[Any, ...]]) -> float:
    """Share of the points that are at most NEAR_M beside the box in space of the true object.

    `frames` are what is there in an image and in space, what is found, likewise, and its points; only points
    of objects that are found count.
    """
    near = []
    for truth, true_places, seen, _, cloud in frames:
        points, places = points_of_cloud(cloud), {one.id: one.bbox for one in true_places.detections}
        for true_row, row in matched(truth, seen):
            box = places[truth.detections[true_row].id]
            centre, size = (
                [getattr(each, axis) for axis in "xyz"] for each in (box.center.position, box.size)
            )
            found = points[points["detection"] == row]
            beside_m = abs(np.stack([found[axis] for axis in "xyz"], axis=1) - centre) - np.array(size) / 2
            near.append((beside_m <= NEAR_M).all(axis=1))
    return float(np.concatenate(near).mean()) if near else 0.0


def from_above(cloud: PointCloud2) -> NDArray[np.uint8]:
    """The points as from above (H, W, 3) in BGR, the camera in the middle of the lower edge, on white."""
    points, seen = points_of_cloud(cloud), np.full((4 * _PX_PER_M, 4 * _PX_PER_M, 3), 255, np.uint8)
    ahead, right = (np.rint(points[axis] * _PX_PER_M).astype(int) for axis in "zx")
    bgr = np.ascontiguousarray(points["rgb"]).view(np.uint8).reshape(-1, 4)[:, :3]
    inside = (ahead < len(seen)) & (abs(right) < len(seen) // 2)
    seen[-1 - ahead[inside], right[inside] + len(seen) // 2] = bgr[inside]
    return np.asarray(cv2.erode(seen, np.ones((2, 2))), np.uint8)  # larger points


def _centres_by_id(message: Detection3DArray) -> dict[str, NDArray[np.float64]]:
    """Centres (3,) in metres, by id; objects without an id are left out."""
    centres = {one.id: one.bbox.center.position for one in message.detections if one.id}
    return {name: np.array((centre.x, centre.y, centre.z)) for name, centre in centres.items()}


def side_by_side(images_bgr: Mapping[str, NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """The images (H, W, 3) side by side, each below its name, on white."""
    height = max(len(pixels) for pixels in images_bgr.values())
    columns = []
    for name, pixels in images_bgr.items():
        edges = (_TITLE_PX, height - len(pixels), 0, _GAP_PX)
        column = cv2.copyMakeBorder(pixels, *edges, cv2.BORDER_CONSTANT, value=_PAPER)
        cv2.putText(column, name, (2, _TITLE_PX - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _INK, 1, cv2.LINE_AA)
        columns.append(column)
    return np.hstack(columns)[:, :-_GAP_PX]


def matched(truth: Detection2DArray, seen: Detection2DArray) -> list[tuple[int, int]]:
    """Rows of matching true and seen objects: one to one, same class, IoU >= MATCHING_IOU."""
    ious = iou_matrix(boxes_xyxy(truth), boxes_xyxy(seen))
    ious[np.array(class_names(truth))[:, None] != np.array(class_names(seen))[None, :]] = 0
    pairs: list[tuple[int, int]] = []
    while ious.size and ious.max() >= MATCHING_IOU:
        row, column = map(int, np.unravel_index(ious.argmax(), ious.shape))
        pairs.append((row, column))
        ious[row, :] = ious[:, column] = 0
    return pairs


def class_names(message: Detection2DArray) -> list[str]:
    """The most probable class of each object."""
    return [detection.results[0].hypothesis.class_id for detection in message.detections]


def boxes_xyxy(message: Detection2DArray) -> NDArray[np.float64]:
    """Boxes (n, 4) in pixels of the source."""
    boxes = [detection.bbox for detection in message.detections]
    rows = [(box.center.position.x, box.center.position.y, box.size_x, box.size_y) for box in boxes]
    cxcywh = np.array(rows, np.float64).reshape(-1, 4)
    return np.hstack((cxcywh[:, :2] - cxcywh[:, 2:] / 2, cxcywh[:, :2] + cxcywh[:, 2:] / 2))


def mask_ious(pairs: list[tuple[int, int]], true: Image, found: Image) -> list[float]:
    """Intersection over union of the pixels of the true and the found object of each pair of rows.

    The images are 16UC1, with i + 1 for the pixels of the i-th object.
    """
    labels = [np.frombuffer(image.data, "<u2").reshape(image.height, image.width) for image in (true, found)]
    masks = [(labels[0] == i + 1, labels[1] == j + 1) for i, j in pairs]
    return [float((a & b).sum() / max((a | b).sum(), 1)) for a, b in masks]
