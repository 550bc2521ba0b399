"""Two cameras on one detector: detections, tracks and places in space, compared with the ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from vision_msgs.msg import Detection2DArray, Detection3DArray

from yolov5_lifecycle.printable import shell_command
from yolov5_lifecycle.ros.demo.ground_truth import matched
from yolov5_lifecycle.ros.demo.stage import CONFIG, DETECTOR, Received, Stage, saved, together

CAMERAS = ("front", "rear")
_CAMERA = f"camera --ros-args -p depth:=true -r __node:={{0}} -r image_raw:={DETECTOR}/{{0}}/image_raw"
COMMANDS = {
    "front camera": f"{_CAMERA} -p seed:=6 -p width:=480 -p height:=360 -p rate:=15.0".format("front"),
    "rear camera": f"{_CAMERA} -p seed:=29 -p width:=400 -p height:=300 -p rate:=12.0".format("rear"),
    "detector": f"detector --ros-args --params-file {shell_command(f'{CONFIG}/demo_cameras.yaml')}",
}
_IMAGES = 100
_NOWHERE = np.full(3, np.inf)
_TITLE_PX, _GAP_PX = 28, 8
_PAPER, _INK = (255, 255, 255), (40, 40, 40)


def demonstrate(stage: Stage) -> str:
    """Drive the detector, save an image and return a summary.

    Raises DemonstrationError, TimeoutError or OSError.
    """
    records = {name: _record(stage, name) for name in CAMERAS}
    stage.transition("configure")
    stage.transition("activate")
    stage.report(f"watching {_IMAGES} images of each camera")
    stage.observer.wait_for(
        lambda: all(len(together(*record)) >= _IMAGES for record in records.values()),
        f"{_IMAGES} images of each camera on {DETECTOR}/CAMERA/detections and detections_3d",
        timeout_s=60.0 + _IMAGES,
    )
    frames = [(name, *each) for name, record in records.items() for each in together(*record).values()]
    recall, switches, error = figures(frames)
    stage.check(recall >= 0.9, f"{recall:.1%} of the shapes found", "at least 90 %")
    stage.check(switches == 0, f"{switches} identity switches", "none")
    stage.check(error <= 0.02, f"median error in space {error:.2%}", "at most 2 %")
    images = {
        name: stage.annotated_image(f"{DETECTOR}/{name}/image", places, 5)  # of the six objects
        for name, (_, _, _, places) in records.items()
    }
    path = saved(side_by_side(images), "cameras.png")
    stage.transition("deactivate")
    stage.transition("cleanup")
    return f"{len(frames)} images of {len(records)} cameras compared, image in {path}"


def figures(frames: Sequence[tuple[Any, ...]]) -> tuple[float, int, float]:
    """Share of the objects that are found, changes of identity, and the median error in space.

    `frames` are names of cameras, each with the messages of `_record` on an image. The error is that of the
    place, as a share of its distance; infinite for an object that has an id and no place.
    """
    true = sum(len(truth.detections) for _, truth, _, _, _ in frames)
    tracks, owners = dict[tuple[str, str], str](), dict[str, tuple[str, str]]()
    found, switches, errors = 0, 0, []
    for camera, truth, true_places, seen, places in frames:
        true_xyz, xyz = _centres_by_id(true_places), _centres_by_id(places)
        for true_row, row in matched(truth, seen):
            found += 1
            name, track = truth.detections[true_row].id, seen.detections[row].id
            if track:
                owner = (camera, name)
                switches += tracks.get(owner, track) != track or owners.get(track, owner) != owner
                tracks[owner], owners[track] = track, owner
                error = np.linalg.norm(xyz.get(track, _NOWHERE) - true_xyz[name])
                errors.append(float(error / np.linalg.norm(true_xyz[name])))
    return found / max(true, 1), switches, float(np.median(errors or [np.inf]))


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


def _record(stage: Stage, name: str) -> tuple[Received, ...]:
    """What is there, in the images of a camera and in space, and what is found, likewise."""
    return (
        stage.collect(Detection2DArray, f"/{name}/truth"),
        stage.collect(Detection3DArray, f"/{name}/ground_truth_3d"),
        stage.collect(Detection2DArray, f"{DETECTOR}/{name}/detections"),
        stage.collect(Detection3DArray, f"{DETECTOR}/{name}/detections_3d"),
    )


def _centres_by_id(message: Detection3DArray) -> dict[str, NDArray[np.float64]]:
    """Centres (3,) in metres, by id; objects without an id are left out."""
    centres = {one.id: one.bbox.center.position for one in message.detections if one.id}
    return {name: np.array((centre.x, centre.y, centre.z)) for name, centre in centres.items()}
