"""The detector process under test, and its camera."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image
from support.depth_messages import camera_info_message, depth_message
from support.detector_process import (
    MAX_PENDING,
    NODE,
    PARAMETERS,
    DetectorProcess,
    as_arguments,
    environment,
    is_balanced,
    scene_image,
)
from vision_msgs.msg import Detection2DArray

from soak import faulty_detector
from soak.finding import Finding, number_of
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point, own_domain
from yolov5_lifecycle.ros.observer import Observer

_UNEXPECTED = re.compile(r"Traceback|unexpected \w+ in", re.IGNORECASE)
_START_S = 120.0
_PACE_S = 0.002
"""Pause between images; one sent at once would replace the one before it unprocessed."""
_ANSWER_S = 5.0
_QUEUE = 1000
_DEPTH_HW = (240, 320)


@dataclass(frozen=True)
class Resources:
    """Operating system resources of a process."""

    resident_mb: float
    threads: int
    files: int

    @classmethod
    def of(cls, process_id: int) -> Resources:
        folder = Path(f"/proc/{process_id}")
        status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
        return cls(
            resident_mb=int(status["VmRSS"].split()[0]) / 1024,
            threads=int(status["Threads"]),
            files=len(list((folder / "fd").iterdir())),
        )


class BalanceWatch:
    """All frame balances reported by one process, in order."""

    def __init__(self) -> None:
        self.told = 0
        self.received = 0
        self.problems: list[str] = []
        """Balances that are wrong, and cameras whose counts have become smaller."""
        self._counts: dict[str, dict[str, int]] = {}

    def take(self, statuses: Mapping[str, Mapping[str, str]]) -> None:
        """Check the values in one message of diagnostics, by camera and of the node, whose name is ""."""
        self.told += 1
        state = statuses[""]["state"]
        self._counts = {
            camera: self._checked(camera, values, state)
            for camera, values in statuses.items()
            if "frames received" in values
        }

    def _checked(self, camera: str, values: Mapping[str, str], state: str) -> dict[str, int]:
        """The counts in `values`, which only grow."""
        before = self._counts.get(camera, {})
        counts = {name: int(value) for name, value in values.items() if name.startswith("frames ")}
        pending, received = counts.pop("frames pending"), counts["frames received"]
        for never_taken in ("frames lost", "frames overtaken"):  # only counted since activation
            counts.pop(never_taken, None)
        under_way = MAX_PENDING if state == "active" else 0
        if not is_balanced(values) or pending > under_way:
            self.problems.append(f"{camera} {state} {values}".lstrip())
        if any(count < before.get(name, 0) for name, count in counts.items()):
            self.problems.append(f"the counts of {camera!r} became smaller")
            before = {}
        self.received += received - before.get("frames received", 0)
        return counts


def exact_balance(watches: Sequence[BalanceWatch]) -> Finding:
    """Whether all balances of all processes follow the rules."""
    problems = [problem for watch in watches for problem in watch.problems]
    told, received = sum(watch.told for watch in watches), sum(watch.received for watch in watches)
    return Finding(
        claim="every frame is in exactly one count",
        done=f"{told} diagnostics of {len(watches)} processes, {received} frames",
        result=number_of("unbalanced", problems),
        limit=f"0; at most {MAX_PENDING} frames under way, none unless active",
        is_met=told > 0 and not problems,
    )


class Subject(DetectorProcess):
    """A monitored detector process: its frame balances and the unexpected exceptions in its log."""

    def __init__(self, process: ChildProcess, observer: Observer, domain: int) -> None:
        self.balance = BalanceWatch()
        self._escaped: dict[str, None] = {}
        observer.create_subscription(DiagnosticArray, "/diagnostics", self._watch, 100)
        super().__init__(process, observer, domain)

    @property
    def escaped(self) -> list[str]:
        """Log lines with unexpected exceptions."""
        self._read_log()
        return list(self._escaped)

    def begin_transition(self, label: str) -> Any:
        """Request a transition; returns the future of the response."""
        return self._raw_transitions.call_async(ChangeState.Request(transition=Transition(label=label)))

    def begin_reload(self, image_size: int) -> Any:
        """Request another network image size; returns the future of the response."""
        size = Parameter("image_size", value=image_size).to_parameter_msg()
        return self._raw_parameters.call_async(SetParameters.Request(parameters=[size]))

    def hear_cameras(self) -> None:
        """Wait for a report of the configured cameras; call it before `cameras` may change.

        Counts of a camera that goes and comes back between two reports begin again, as if frames were lost.
        """
        told = self.balance.told
        self.observer.wait_for(lambda: self.balance.told > told, "diagnostics")

    def reset(self) -> None:
        """Return to unconfigured, with the initial parameters and clock."""
        self.hear_cameras()
        super().reset()
        assert self.node.set_parameters(use_sim_time=False) == ""

    def resources(self) -> Resources:
        return Resources.of(self.process.process_id)

    def _watch(self, message: DiagnosticArray) -> None:
        self.balance.take(
            {
                _camera_of(status.name): {value.key: value.value for value in status.values}
                for status in message.status
            }
        )
        self._read_log()  # now, as it keeps only the last lines

    def _read_log(self) -> None:
        self._escaped |= dict.fromkeys(exceptions_in(self.process.output))


class Sender:
    """Sends images to an active subject, as its camera `name` or its only one, and hears what is detected."""

    def __init__(self, subject: Subject, name: str = "") -> None:
        self._name = name
        self._observer = subject.observer
        self._last: Any = None
        prefix = f"{NODE}/{name}".rstrip("/")
        self._images = self._observer.create_publisher(Image, f"{prefix}/image_raw", 1)
        self._depth = self._observer.create_publisher(Image, f"{prefix}/depth/image_raw", 1)
        self._camera_info = self._observer.create_publisher(CameraInfo, f"{prefix}/depth/camera_info", 1)
        self._observer.create_subscription(Detection2DArray, f"{prefix}/detections", self._hear, _QUEUE)

    def send(self, message: Any) -> None:
        self._images.publish(message)
        time.sleep(_PACE_S)

    def send_depth(self) -> None:
        """A wall two metres away, now."""
        now_s = time.time()
        self._camera_info.publish(camera_info_message(now_s))
        self._depth.publish(depth_message(np.full(_DEPTH_HW, 2.0, np.float32), now_s))

    def send_whole(self) -> None:
        """Send a readable image until it is detected."""
        self._observer.wait_for(lambda: self._images.get_subscription_count() > 0, "the node to subscribe")
        image, sent_s = scene_image(), float("-inf")

        def is_detected() -> bool:
            nonlocal sent_s
            if time.monotonic() - sent_s > _ANSWER_S:
                self.send(image)
                sent_s = time.monotonic()
            return bool(self._last == image.header)

        self._observer.wait_for(is_detected, f"the detections of a whole image {self._name}".rstrip())

    def _hear(self, message: Detection2DArray) -> None:
        self._last = message.header


def _camera_of(status_name: str) -> str:
    """`front` in `/yolov5: front`, "" in `/yolov5: detection`, the status of the node."""
    part = status_name.partition(": ")[2]
    return "" if part == "detection" else part


def exceptions_in(log: str) -> list[str]:
    """The lines of a detector log with unexpected exceptions."""
    return [line for line in log.splitlines() if _UNEXPECTED.search(line)]


@contextmanager
def subject() -> Iterator[Subject]:
    """A process with the embedded model, in its own ROS domain."""
    with own_domain() as domain, subject_in(domain) as subject:
        yield subject


@contextmanager
def subject_in(domain: int) -> Iterator[Subject]:
    """A process in `domain`."""
    command = [sys.executable, faulty_detector.__file__, "--ros-args", *as_arguments(PARAMETERS)]
    with ChildProcess("detector", command, environment(domain)) as process:
        process.wait_for_output("next step: ", _START_S)
        with closing(Observer("client", domain=domain, check=process.check_running)) as observer:
            yield Subject(process, observer, domain)


def camera(domain: int, **parameters: object) -> ChildProcess:
    """A camera process of the subject in `domain`."""
    words = [entry_point("camera"), "--ros-args", "-r", f"image_raw:={NODE}/image_raw"]
    return ChildProcess("camera", [*words, *as_arguments(parameters)], environment(domain))
