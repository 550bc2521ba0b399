"""The node's status on /diagnostics, in every lifecycle state."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import lru_cache

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Header

from yolov5_lifecycle.collecting.collector import CollectorStatus
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.printable import in_lines
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
        problem, hint, remark, values = self.problem, "", self._inactivity, dict[str, str]()
        if each := self.of_cameras:
            problems = [f"{camera.name}: {camera.problem}" for camera in each if camera.problem]
            hints = [f"{camera.name}: {camera.hint}" for camera in each if camera.hint]
            hint = next(iter(problems + hints), "")
            values = {"cameras": ", ".join(camera.name for camera in each)}
        elif self.cameras:
            one = self._summary(self.cameras[0])
            problem, hint, remark, values = self.problem or one.problem, one.hint, one.remark, one.values
        return Summary(NODE_STATUS, problem, self.namesakes or hint, remark, self._values(problem) | values)

    @property
    def of_cameras(self) -> list[Summary]:
        """Summary of each named camera."""
        return [self._summary(status) for status in self.cameras if status.camera.name]

    def _summary(self, status: CameraStatus) -> Summary:
        hint, remark = (status.hint, status.remark) if self.state == "active" else ("", self._inactivity)
        return Summary(status.camera.name, status.problem, hint, remark, status.values())

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


_MAX_VALUE = 5_000
"""Max characters of one value; a path has up to 4096."""
_REPEAT_S = 60.0
"""A recurring reason is logged at most once in this time."""


@dataclass(eq=False)
class Diagnostics:
    """Publishes `status()` every `period_s`; logs namesakes, and why an active node has no output.

    `clock` returns monotonic seconds.
    """

    node: Node
    status: Callable[[], Status]
    _: KW_ONLY
    period_s: float
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._reasons: dict[str, str] = {}
        """Without numbers, of the last summaries by name."""
        self._logged_s: dict[tuple[str, str], float] = {}
        self._publisher = self.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Steady time: simulated time may be paused (use_sim_time without /clock).
        self._timer = self.node.create_timer(
            self.period_s, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def publish(self) -> None:
        """Publish the current status now and log its reasons if they are new."""
        stamp = self.node.get_clock().now().to_msg()  # nothing in the status is older
        status = self.status()
        of_node, of_cameras = status.of_node, status.of_cameras
        name = self.node.get_fully_qualified_name()
        self._publisher.publish(
            DiagnosticArray(
                header=Header(stamp=stamp),
                status=[diagnostic_status(summary, name) for summary in (of_node, *of_cameras)],
            )
        )
        detecting = of_cameras or [of_node] if status.state == "active" else []
        self._log_reasons([of_node] if status.namesakes else detecting)

    def _log_reasons(self, summaries: Sequence[Summary]) -> None:
        """Log each reason when it appears, and when it recurs after `_REPEAT_S`.

        A text in which only numbers changed is the same reason.
        """
        log, now_s, before = self.node.get_logger(), self.clock(), self._reasons
        self._reasons = {each.name: re.sub(r"[\d.]+", "", each.hint or each.remark) for each in summaries}
        self._logged_s = {
            key: at_s
            for key, at_s in self._logged_s.items()
            if key[0] in self._reasons and now_s - at_s < _REPEAT_S
        }
        for each in summaries:
            key = each.name, self._reasons[each.name]
            if key[1] in ("", before.get(each.name, "")) or key in self._logged_s:
                continue
            self._logged_s[key] = now_s
            whose = "" if each.name in ("", NODE_STATUS) else f"{each.name}: "
            if each.hint:
                log.warning(f"{whose}{each.hint}")
            else:
                log.info(f"{whose}{each.remark}")


def diagnostic_status(summary: Summary, node_name: str) -> DiagnosticStatus:
    """Convert `summary` to a DiagnosticStatus: ERROR with a problem, WARN with a hint, else OK."""
    level = DiagnosticStatus.WARN if summary.hint else DiagnosticStatus.OK
    return DiagnosticStatus(
        level=DiagnosticStatus.ERROR if summary.problem else level,
        name=f"{node_name}: {summary.name}",
        message=in_lines(summary.message, _MAX_VALUE),
        hardware_id=node_name,
        values=[
            KeyValue(key=key, value=in_lines(value, _MAX_VALUE)) for key, value in summary.values.items()
        ],
    )
