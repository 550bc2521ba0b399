"""Snapshot of the node with all its cameras, for diagnostics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from yolov5_lifecycle.collecting.collector import CollectorStatus
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.ros.detector.camera_status import CameraStatus
from yolov5_lifecycle.settings.camera_names import NODE_STATUS
from yolov5_lifecycle.settings.settings import Settings

_REMEDIES = {
    "unconfigured": ": configure and activate the node to detect",
    "inactive": ": activate the node to detect",
}


@dataclass(frozen=True)
class Summary:
    """Content of one DiagnosticStatus.

    A `problem` makes it an error, a `hint` a warning; a `remark` explains why there is no output although
    nothing is wrong.
    """

    name: str
    problem: str
    hint: str
    remark: str
    values: dict[str, str]
    is_of_camera: bool = False

    @property
    def message(self) -> str:
        """One-line human-readable summary."""
        return self.problem or self.hint or self.remark or "detecting"


@dataclass(frozen=True)
class Status:
    """Snapshot of the node.

    `problem`: the last reported one. `settings`: from configure on; `model`: while active.
    `cameras`: the named ones, otherwise one with the name ""; none if ROS refuses the names of their topics.
    `abandoned_threads`: threads that hung during deactivate and are still running.
    `resident_mb`: RAM of the process, None if unknown. `collected`: None without `collect_dir`.
    `namesakes`: that other nodes have the name of this one, else "".
    """

    state: str
    problem: str
    settings: Settings | None
    model: PreparedModel | None
    cameras: tuple[CameraStatus, ...]
    abandoned_threads: int
    resident_mb: float | None
    collected: CollectorStatus | None
    namesakes: str = ""

    @property
    def of_node(self) -> Summary:
        """Summary of the node: all values of its only camera, or the first problem of several cameras."""
        each = self.of_cameras
        if not self.cameras:
            return Summary(
                NODE_STATUS, self.problem, self.namesakes, self._inactivity, self._values(self.problem)
            )
        if not each:
            one, problem = self._summary(self.cameras[0]), self.problem or self.cameras[0].problem
            hint = self.namesakes or one.hint
            return Summary(NODE_STATUS, problem, hint, one.remark, self._values(problem) | one.values)
        problems = [f"{camera.name}: {camera.problem}" for camera in each if camera.problem]
        hints = [f"{camera.name}: {camera.hint}" for camera in each if camera.hint]
        return Summary(
            NODE_STATUS,
            problem=self.problem,
            hint=self.namesakes or next(iter(problems + hints), ""),
            remark=self._inactivity,
            values=self._values(self.problem) | {"cameras": ", ".join(camera.name for camera in each)},
        )

    @property
    def of_cameras(self) -> list[Summary]:
        """Summary of each named camera."""
        return [self._summary(camera) for camera in self.cameras if camera.camera]

    def _summary(self, camera: CameraStatus) -> Summary:
        hint, remark = (camera.hint, camera.remark) if self.state == "active" else ("", self._inactivity)
        return Summary(camera.camera, camera.problem, hint, remark, camera.values(), is_of_camera=True)

    @property
    def _inactivity(self) -> str:
        return "" if self.state == "active" else self.state + _REMEDIES.get(self.state, "")

    def _values(self, problem: str) -> dict[str, str]:
        values = {"state": self.state, "last problem": problem}
        values["abandoned threads"] = str(self.abandoned_threads)
        if self.resident_mb is not None:
            values["resident memory MB"] = f"{self.resident_mb:.0f}"
        if self.settings is not None:
            values["configuration"] = _digest(self.settings)
        if self.collected is not None:
            values |= _collected(self.collected)
        return values | (self.model.facts if self.model is not None else {})


def _collected(status: CollectorStatus) -> dict[str, str]:
    return {
        "images collected": str(status.kept),
        "images not collected, near duplicates": str(status.duplicates),
        "images not collected, less valuable": str(status.outranked),
        "images not collected, disk too slow": str(status.dropped),
        "images in collect_dir": str(status.frames),
        "collect_dir MB": f"{status.megabytes:.1f}",
    }


@lru_cache(maxsize=1)  # asked every second; with lists of 10,000 classes it takes long
def _digest(settings: Settings) -> str:
    return settings.digest()
