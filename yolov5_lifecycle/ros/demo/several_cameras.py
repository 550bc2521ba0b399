"""Two cameras on one detector: detections, tracks and places in space, compared with ground truth."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.demo.camera_figures import CameraFigures, figures
from yolov5_lifecycle.ros.demo.camera_record import CameraRecord, JudgedFrame
from yolov5_lifecycle.ros.demo.child_process import entry_point
from yolov5_lifecycle.ros.demo.driven_detector import DETECTOR, DrivenDetector
from yolov5_lifecycle.ros.demo.image_file import saved, side_by_side
from yolov5_lifecycle.ros.demo.observer import PATIENCE_S, Observer
from yolov5_lifecycle.ros.demo.outcome import Outcome, aligned
from yolov5_lifecycle.ros.demo.processes import DETECTOR_PROCESS, OUTPUT, demonstrated, project_file

FRAMES = 100
"""Images of each camera to compare by default."""
MAX_RATE_HZ = 5.0
"""`max_rate` of the rear camera in config/demo_cameras.yaml."""
_RATE_SLACK = 1.1
_MIN_OBJECTS = 5
"""In the image, of the six in the scene."""


@dataclass(frozen=True)
class SceneCamera:
    """A camera of the demonstration, and the highest rate at which objects are detected in its images."""

    name: str
    seed: int
    size_hw: tuple[int, int]
    rate_hz: float
    max_rate_hz: float

    @property
    def command(self) -> list[str]:
        """Command line of its process: all its topics are below its name."""
        parameters = {
            "seed": self.seed,
            "width": self.size_hw[1],
            "height": self.size_hw[0],
            "rate": self.rate_hz,
            "depth": True,
            "frame_id": f"{self.name}_optical_frame",
        }
        remappings = {"__node": self.name, "image_raw": f"/{self.name}/image_raw"}
        words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        return [entry_point("camera"), "--ros-args", *words, *_remapped(remappings)]

    @property
    def remappings(self) -> dict[str, str]:
        """Remappings of the detector's input topics to those of the camera."""
        topics = ("image_raw", "depth/image_raw", "depth/camera_info")
        return {f"~/{self.name}/{topic}": f"/{self.name}/{topic}" for topic in topics}


CAMERAS = (
    SceneCamera("front", seed=6, size_hw=(360, 480), rate_hz=15.0, max_rate_hz=15.0),
    SceneCamera("rear", seed=29, size_hw=(300, 400), rate_hz=12.0, max_rate_hz=MAX_RATE_HZ),
)


def demonstrate_cameras(frames: int, report: Callable[[str], None]) -> Outcome:
    """Run the demonstration with this many images of each camera; writes image and figures below OUTPUT.

    Raises what `demonstrated` raises.
    """
    detector_words = ["--params-file", str(project_file("config/demo_cameras.yaml"))]
    for camera in CAMERAS:
        detector_words += _remapped(camera.remappings)
    commands = {f"{camera.name} camera": camera.command for camera in CAMERAS}
    commands[DETECTOR_PROCESS] = [entry_point("detector"), "--ros-args", *detector_words]
    found = demonstrated(
        commands,
        lambda observer, detector: CamerasDemonstration(observer, detector, report=report).run(frames),
        report=report,
    )
    problems = problems_of(found)
    path = _written(found, problems)
    watched = sum(one.frames for one in found.values())
    summary = f"{watched} frames of {len(found)} cameras compared, figures in {path}"
    return Outcome(_table(found), f"{summary}, image in {_image_path()}", tuple(problems))


class CamerasDemonstration:
    """Drives the detector and compares what it finds with the ground truth of CAMERAS."""

    def __init__(
        self, observer: Observer, detector: DrivenDetector, *, report: Callable[[str], None]
    ) -> None:
        self._observer = observer
        self._detector = detector
        self._report = report
        self._records = {
            camera.name: CameraRecord(
                observer, camera=f"/{camera.name}", detections=f"{DETECTOR}/{camera.name}"
            )
            for camera in CAMERAS
        }

    def run(self, frames: int) -> dict[str, CameraFigures]:
        """The figures of each camera. Raises DemonstrationError, NoAnswerError or OSError."""
        self._report("waiting for the cameras and the detector")
        self._observer.wait_for(
            lambda: all(record.is_seen for record in self._records.values()), "ground truth of all cameras"
        )
        self._detector.wait_until_reachable()
        self._detector.transition("configure", "inactive")
        self._detector.transition("activate", "active")
        found = self._watch(frames)
        self._save_image()
        self._detector.transition("deactivate", "inactive")
        self._detector.transition("cleanup", "unconfigured")
        return found

    def _watch(self, count: int) -> dict[str, CameraFigures]:
        self._report(f"watching {count} images of each camera")
        now_ns = time.time_ns()

        def seen() -> dict[str, list[JudgedFrame]]:
            return {name: record.frames_since(now_ns) for name, record in self._records.items()}

        self._observer.wait_for(
            lambda: all(len(frames) >= count for frames in seen().values()),
            f"{count} images of each camera on {DETECTOR}/CAMERA/detections and detections_3d",
            timeout_s=PATIENCE_S + count,
        )
        return {name: figures(frames) for name, frames in seen().items()}

    def _save_image(self) -> None:
        self._report("waiting for annotated images in which every object has an id and a distance")
        for record in self._records.values():
            record.show_images()

        def complete() -> dict[str, ColourImage | None]:
            return {name: record.complete_image(_MIN_OBJECTS) for name, record in self._records.items()}

        self._observer.wait_for(lambda: None not in complete().values(), "such an image of each camera")
        shown = {name: image for name, image in complete().items() if image is not None}
        saved(side_by_side(shown), _image_path())


def _remapped(names: Mapping[str, str]) -> list[str]:
    return [word for name, other in names.items() for word in ("-r", f"{name}:={other}")]


def _image_path() -> Path:
    return OUTPUT / "cameras.png"


def problems_of(found: Mapping[str, CameraFigures]) -> list[str]:
    """Results that are worse than required, for each camera and for all together."""
    problems = [f"{name}: {problem}" for name, one in found.items() for problem in one.problems()]
    for camera in CAMERAS:
        rate_hz = found[camera.name].rate_hz
        if rate_hz > _RATE_SLACK * camera.max_rate_hz:
            problems.append(f"{camera.name}: {rate_hz:.1f} Hz, expected at most {camera.max_rate_hz:g} Hz")
    ids = [name for one in found.values() for name in one.ids]
    if shared := sorted({name for name in ids if ids.count(name) > 1}):
        problems.append(f"ids that both cameras use: {', '.join(shared)}")
    return problems


def _written(found: Mapping[str, CameraFigures], problems: list[str]) -> Path:
    path = OUTPUT / "cameras.json"
    content = {"cameras": {name: one.as_json() for name, one in found.items()}, "problems": problems}
    path.write_text(json.dumps(content, indent=2) + "\n")
    return path


def _table(found: Mapping[str, CameraFigures]) -> str:
    heads = [
        "camera",
        "frames",
        "Hz",
        "precision",
        "recall",
        "ids",
        "switches",
        "in space",
        "error",
        "median ms",
    ]
    return aligned([heads, *(_row(name, one) for name, one in found.items())])


def _row(name: str, found: CameraFigures) -> list[str]:
    return [
        name,
        str(found.frames),
        f"{found.rate_hz:.1f}",
        f"{found.precision:.1%}",
        f"{found.recall:.1%}",
        str(len(found.ids)),
        str(found.switches),
        f"{found.placed:.1%}",
        "" if found.median_error_percent is None else f"{found.median_error_percent:.2f} %",
        f"{found.median_latency_ms:.1f}",
    ]
