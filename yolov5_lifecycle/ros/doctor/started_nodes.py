"""Nodes that `doctor` starts: a camera, whose images must arrive, and a detector, for its whole life."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field

from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

from yolov5_lifecycle.atomic_file import temporary_folder
from yolov5_lifecycle.doctor.finding import Finding, Groups, Machine, error, ok, warning
from yolov5_lifecycle.input_file import resolve_package
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import show_report
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point, isolated, own_domain
from yolov5_lifecycle.ros.demo.demonstrations import ONE_CAMERA, one_camera
from yolov5_lifecycle.ros.demo.stage import DemonstrationError, stage
from yolov5_lifecycle.ros.doctor.environment import PROFILE
from yolov5_lifecycle.ros.messages import stamp_ns
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.ros.shared_memory import PROFILE_VARIABLES

_WIDTH, _HEIGHT = 1280, 720
_RATE_HZ = 15.0
_WATCHED_S = 4.0
_START_S, _DISCOVERY_S = 600.0, 20.0
"""For a camera that sends, which a busy machine delays and `--time` ends, and for its first image."""
_FEW_LOST = 0.05


@dataclass
class Arrivals:
    """Images that arrived: their numbers, given by the publisher, and the time since their stamps."""

    numbers: list[int] = field(default_factory=list)
    latencies_ms: list[float] = field(default_factory=list)

    def take(self, message: Image, info: Mapping[str, int | None]) -> None:
        """Count an image; one without a number is counted as the next."""
        number = info["publication_sequence_number"]
        self.numbers.append(len(self.numbers) if number is None else number)
        self.latencies_ms.append((time.time_ns() - stamp_ns(message.header)) / 1e6)

    @property
    def lost(self) -> float:
        """The share of the images between the first and the last that did not arrive; 1 if none did."""
        sent = self.numbers[-1] - self.numbers[0] + 1 if self.numbers else 1
        return 1 - len(self.numbers) / sent

    def __str__(self) -> str:
        rate_hz = len(self.numbers) / _WATCHED_S
        return (
            f"{self.lost:.0%} of the images of {_WIDTH}x{_HEIGHT} lost, {rate_hz:.1f} of {_RATE_HZ:g} Hz "
            f"received, {statistics.median(self.latencies_ms):.1f} ms each"
        )


def _transport(_: Machine) -> Iterator[Finding]:
    found = _watched()
    if not found.numbers:
        yield error(
            f"no image arrived from another process within {_DISCOVERY_S:g} s",
            remedy="Check the settings above (middleware, discovery), and that a firewall lets UDP to this "
            "machine pass: `ros2 doctor --report` shows the network.",
        )
    elif found.lost <= _FEW_LOST:
        yield ok(str(found))
    else:
        remedy = "Lower the camera's rate or size, or send compressed images: this machine is too busy."
        if not any(os.environ.get(variable) for variable in PROFILE_VARIABLES):
            profile = os.environ[PROFILE_VARIABLES[0]] = resolve_package(PROFILE)
            if (better := _watched()).lost <= _FEW_LOST:
                remedy = (
                    f"Start cameras with `export {PROFILE_VARIABLES[0]}={profile}`; tried here: {better}."
                )
        yield warning(str(found), remedy=remedy)


def _watched() -> Arrivals:
    """The images of a new camera process, watched for some seconds from the first.

    The discovery range is LOCALHOST, so that no other machine sees the camera. FASTDDS_BUILTIN_TRANSPORTS
    then has no effect, because rmw_fastrtps chooses the transports itself, in its `src/participant.cpp`.
    """
    arrivals = Arrivals()
    values = {"width": _WIDTH, "height": _HEIGHT, "rate": _RATE_HZ, "reliability": "best_effort"}
    words = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
    with own_domain() as domain, temporary_folder() as folder:
        environment = isolated(os.environ, domain) | {"ROS_LOG_DIR": str(folder)}
        os.environ.clear()
        os.environ.update(environment)
        with (
            ChildProcess("camera", [entry_point("camera"), "--ros-args", *words], environment) as camera,
            closing(Observer("doctor", domain=domain, check=camera.check_running)) as observer,
        ):
            camera.wait_for_output("publishing", _START_S)
            observer.create_subscription(Image, "/image_raw", arrivals.take, qos_profile_sensor_data)
            with suppress(TimeoutError):
                observer.wait_for(lambda: bool(arrivals.numbers), "an image", timeout_s=_DISCOVERY_S)
                observer.work_for(_WATCHED_S)
    return arrivals


def _life(_: Machine) -> Iterator[Finding]:
    """What `demo` does, which drives every transition, live changes and a model swap."""
    with temporary_folder() as folder:
        os.chdir(folder)  # the demonstration writes below it
        try:
            # The last steps are quoted if no further one follows in time.
            with stage(ONE_CAMERA, lambda step: show_report(f"{step}\n")) as driven:
                found = one_camera(driven).partition(", image")[0]
        except (DemonstrationError, OSError, RuntimeError) as problem:
            yield error(
                in_one_line(str(problem), 800),
                remedy="Correct the errors above first; then run `demo`, which shows every step, and report "
                "its output.",
            )
        else:
            told = "configured, activated, changed, model swapped, deactivated, activated again, shut down"
            yield ok(f"{told}: {found}")


CHECKS: Groups = {"transport": {"image transport": _transport}, "node": {"node": _life}}
