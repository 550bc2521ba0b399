"""End-to-end measurement: a camera process publishes, the detector process detects, a third subscribes."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
from vision_msgs.msg import Detection2DArray

from benchmark import light_camera
from benchmark.process_memory import peak_resident_mb
from benchmark.process_time import cpu_s
from benchmark.work import scene_image
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point, isolated, own_domain
from yolov5_lifecycle.ros.messages import stamp_ns
from yolov5_lifecycle.ros.observer import Observer, RemoteLifecycleNode

_PROFILE = Path(__file__).parents[1] / "config" / "shm.xml"
_NODE = "/yolov5"
_SETTLING_S = 1.0


@dataclass(frozen=True)
class Passage:
    """Measurements while a camera ran: latencies from the image stamp, and resources of the node."""

    latencies_ms: list[float]
    rate_hz: float
    cpu_ms_per_frame: float


class MeasuredDetector:
    """A configured detector process and its observer. Created by `detector_node`."""

    def __init__(self, observer: Observer, process: ChildProcess, environment: Mapping[str, str]) -> None:
        self._observer = observer
        self._process = process
        self._environment = environment
        self.node = RemoteLifecycleNode(observer, _NODE)
        self.node.wait_until_reachable()
        self._change("configure")

    def activate_s(self) -> float:
        """Duration of `activate`."""
        begun_s = time.monotonic()
        self._change("activate")
        return time.monotonic() - begun_s

    def deactivate(self) -> None:
        self._change("deactivate")

    @property
    def peak_resident_mb(self) -> float:
        """Peak resident memory of the process."""
        return peak_resident_mb(self._process.process_id)

    def watch(self, image: Path, *, rate_hz: float, frames: int) -> Passage:
        """Publish `image` repeatedly until `frames` detections are received."""
        seen: list[tuple[int, int]] = []  # stamp and arrival in ns
        topic = f"{_NODE}/detections"
        subscription = self._observer.create_subscription(
            Detection2DArray,
            topic,
            lambda message: seen.append((stamp_ns(message.header), time.time_ns())),
            10,
        )
        with self._camera(image, rate_hz):
            self._observer.wait_for(lambda: bool(seen), "the first detections")
            self._observer.work_for(_SETTLING_S)
            seen.clear()
            cpu_begun_s = self._cpu_s()
            self._observer.wait_for(lambda: len(seen) >= frames, f"{frames} detections")
            used_s = self._cpu_s() - cpu_begun_s
        self._observer.destroy_subscription(subscription)
        latencies_ms = [(arrival - stamp) / 1e6 for stamp, arrival in seen]
        taken_s = (seen[-1][0] - seen[0][0]) / 1e9
        return Passage(latencies_ms, (len(seen) - 1) / taken_s, 1e3 * used_s / len(seen))

    def idle_cpu_share(self, image: Path, *, rate_hz: float, duration_s: float) -> float:
        """CPU share of one core that the active node uses while a camera runs but nobody subscribes."""
        with self._camera(image, rate_hz):
            self._observer.wait_for(
                lambda: self._observer.count_publishers(f"{_NODE}/image_raw") > 0, "the camera"
            )
            self._observer.work_for(_SETTLING_S)
            cpu_begun_s = self._cpu_s()
            self._observer.work_for(duration_s)
            return (self._cpu_s() - cpu_begun_s) / duration_s

    def set_parameters(self, **values: object) -> None:
        if refusal := self.node.set_parameters(**values):
            raise RuntimeError(f"setting {values} was refused: {refusal}")

    @contextmanager
    def _camera(self, image: Path, rate_hz: float) -> Iterator[None]:
        command = [sys.executable, light_camera.__file__, str(image), str(rate_hz), f"{_NODE}/image_raw"]
        with ChildProcess("camera", command, self._environment):
            yield

    def _change(self, transition: str) -> None:
        if not self.node.change_state(transition):
            raise RuntimeError(f"the detector refused to {transition}:\n{self._process.last_words}")

    def _cpu_s(self) -> float:
        return cpu_s(self._process.process_id)


@contextmanager
def detector_node(weights: Path, cache: Path) -> Iterator[MeasuredDetector]:
    """A configured detector with `weights`, which caches its choice of runtime in `cache`."""
    with ExitStack() as stack:
        domain = stack.enter_context(own_domain())
        environment = isolated(os.environ, domain) | {
            "AMENT_PREFIX_PATH": sys.prefix,
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(_PROFILE),
            "XDG_CACHE_HOME": str(cache),
        }
        os.environ.update(environment)
        command = [entry_point("detector"), "--ros-args", "-p", f"weights:={weights}", "-p", "device:=cpu"]
        process = stack.enter_context(ChildProcess("detector", command, environment))
        observer = stack.enter_context(closing(Observer("bench", domain=domain, check=process.check_running)))
        yield MeasuredDetector(observer, process, environment)


def image_file(image_hw: tuple[int, int], folder: Path) -> Path:
    """The scene as an image file that a camera reads quickly."""
    path = folder / f"{image_hw[1]}x{image_hw[0]}.bmp"
    if not cv2.imwrite(str(path), scene_image(image_hw).pixels):
        raise OSError(f"{path} cannot be written")
    return path
