"""Detector processes for several cameras: one node for all of them, or a node for each.

This process must not import torch, whose libraries would count as shared with the detectors.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

from std_srvs.srv import Trigger
from vision_msgs.msg import Detection2DArray

from benchmark import light_camera
from benchmark.process_memory import cpu_s, peak_resident_mb, proportional_mb, resident_mb
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point, isolated, own_domain
from yolov5_lifecycle.ros.messages import stamp_ns
from yolov5_lifecycle.ros.observer import Observer, RemoteLifecycleNode

Layout = Literal["one node", "a node each"]
LAYOUTS: tuple[Layout, Layout] = ("one node", "a node each")
_PROFILE = Path(__file__).parents[1] / "config" / "shm.xml"
_NODE = "/yolov5"
_SETTLING_S = 1.0
_QUEUE = 100


def materials(image_hw: tuple[int, int], folder: Path) -> tuple[Path, Path]:
    """Untrained weights and an image in `folder`, created in a process that exits, as it needs torch."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_made, image_hw, folder).result()


def _made(image_hw: tuple[int, int], folder: Path) -> tuple[Path, Path]:
    from benchmark.models import untrained_weights
    from benchmark.work import image_file

    return untrained_weights("n", folder), image_file(image_hw, folder)


@dataclass(frozen=True)
class Arrival:
    """Detections of one image of `camera`: its stamp, and when they were received."""

    camera: str
    stamp_ns: int
    received_ns: int

    @property
    def latency_ms(self) -> float:
        return (self.received_ns - self.stamp_ns) / 1e6


@dataclass(frozen=True)
class Passage:
    """One measurement: arrivals in `duration_s`, in order, and resources used by all detector processes."""

    arrivals: Sequence[Arrival]
    duration_s: float
    cpu_s: float
    proportional_mb: float
    resident_mb: float

    @property
    def rate_hz(self) -> float:
        return len(self.arrivals) / self.duration_s

    @property
    def stamped_hz(self) -> float:
        """The rate of the images of the only camera, by their stamps."""
        first, *_, last = (arrival.stamp_ns for arrival in self.arrivals)
        return (len(self.arrivals) - 1) / ((last - first) / 1e9)

    @property
    def cpu_percent(self) -> float:
        """Of one core."""
        return 100 * self.cpu_s / self.duration_s

    @property
    def cpu_ms(self) -> float:
        """For one detection."""
        return 1e3 * self.cpu_s / len(self.arrivals)

    @property
    def latencies_ms(self) -> list[float]:
        return [arrival.latency_ms for arrival in self.arrivals]

    @property
    def counts(self) -> Counter[str]:
        """Detected images of each camera."""
        return Counter(arrival.camera for arrival in self.arrivals)


class Fleet:
    """Active detector processes for cameras, and their observer. Created by `active_fleet`."""

    def __init__(
        self,
        observer: Observer,
        processes: Mapping[str, ChildProcess],
        prefixes: Mapping[str, str],
        environment: Mapping[str, str],
    ) -> None:
        self.nodes = [RemoteLifecycleNode(observer, name) for name in processes]
        self._observer = observer
        self._processes = [*processes.values()]
        self._prefixes = prefixes
        self._environment = environment
        self._arrivals: list[Arrival] = []
        self._subscriptions = [
            observer.create_subscription(
                Detection2DArray, f"{prefix}/detections", partial(self._receive, camera), _QUEUE
            )
            for camera, prefix in prefixes.items()
        ]
        for node in self.nodes:
            node.wait_until_reachable()
        self.change("configure")
        self.activation_s = self.change("activate")

    def change(self, transition: str) -> float:
        """Let every node make the transition; returns the duration in seconds."""
        begun_s = time.monotonic()
        for node, process in zip(self.nodes, self._processes, strict=True):
            if not node.change_state(transition):
                raise RuntimeError(f"{process.name} refused to {transition}:\n{process.last_words}")
        return time.monotonic() - begun_s

    def camera(self, name: str, image: Path, *, rate_hz: float) -> ChildProcess:
        """A process that publishes `image`."""
        words = [str(image), str(rate_hz), f"{self._prefixes[name]}/image_raw"]
        profile = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(_PROFILE)}
        command = [sys.executable, light_camera.__file__, *words]
        return ChildProcess(f"camera {name}", command, {**self._environment, **profile})

    def wait_for(self, names: Sequence[str]) -> None:
        """Wait until images of all cameras in `names` are detected."""
        self._arrivals.clear()
        self._wait_for_arrivals(names)
        self._observer.work_for(_SETTLING_S)

    def watch(self, names: Sequence[str], duration_s: float = 0.0, *, frames: int = 1) -> Passage:
        """What arrives in `duration_s`, or until `frames` images, some of each of `names`, are detected."""
        begun_s, cpu_begun_s = time.monotonic(), self._cpu_s()
        self._arrivals.clear()
        self._observer.work_for(duration_s)
        self._wait_for_arrivals(names)
        self._observer.wait_for(lambda: len(self._arrivals) >= frames, f"{frames} detections")
        arrivals = tuple(self._arrivals)
        return Passage(
            arrivals=arrivals,
            duration_s=time.monotonic() - begun_s,
            cpu_s=self._cpu_s() - cpu_begun_s,
            proportional_mb=sum(proportional_mb(process.process_id) for process in self._processes),
            resident_mb=sum(resident_mb(process.process_id) for process in self._processes),
        )

    def idle_cpu_share(self, name: str, image: Path, *, rate_hz: float, duration_s: float) -> float:
        """CPU share of one core that the nodes use from now on, while a camera runs but nobody subscribes."""
        while self._subscriptions:
            self._observer.destroy_subscription(self._subscriptions.pop())
        topic = f"{self._prefixes[name]}/image_raw"
        with self.camera(name, image, rate_hz=rate_hz):
            self._observer.wait_for(lambda: self._observer.count_publishers(topic) > 0, "the camera")
            self._observer.work_for(_SETTLING_S)
            cpu_begun_s = self._cpu_s()
            self._observer.work_for(duration_s)
            return (self._cpu_s() - cpu_begun_s) / duration_s

    def collect_every(self, period_s: float) -> None:
        """From now on, ask each detector to keep the next image every `period_s` seconds."""
        for prefix in self._prefixes.values():
            client = self._observer.create_client(Trigger, f"{prefix}/collect")
            self._observer.create_timer(period_s, partial(client.call_async, Trigger.Request()))

    @property
    def peak_resident_mb(self) -> float:
        return sum(peak_resident_mb(process.process_id) for process in self._processes)

    def _wait_for_arrivals(self, names: Sequence[str]) -> None:
        self._observer.wait_for(
            lambda: {arrival.camera for arrival in self._arrivals} >= {*names}, f"detections of {names}"
        )

    def _cpu_s(self) -> float:
        return sum(cpu_s(process.process_id) for process in self._processes)

    def _receive(self, camera: str, message: Detection2DArray) -> None:
        self._arrivals.append(Arrival(camera, stamp_ns(message.header), time.time_ns()))


@contextmanager
def active_fleet(
    layout: Layout, cameras: Sequence[str], *, weights: Path, cache: Path, **parameters: object
) -> Iterator[Fleet]:
    """Detectors for `cameras`, with `weights` and other `parameters`; choices of runtime are in `cache`."""
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)  # where the observer finds the types of messages
    with ExitStack() as stack:
        domain = stack.enter_context(own_domain())
        environment = isolated(os.environ, domain) | {"XDG_CACHE_HOME": str(cache)}
        given = {"weights": weights, "device": "cpu"} | parameters
        processes = {
            node: stack.enter_context(ChildProcess(node, _command(node, given | own), environment))
            for node, own in _nodes(layout, cameras).items()
        }

        def check() -> None:
            for process in processes.values():
                process.check_running()

        observer = stack.enter_context(closing(Observer("bench", domain=domain, check=check)))
        yield Fleet(observer, processes, _prefixes(layout, cameras), environment)


def _nodes(layout: Layout, cameras: Sequence[str]) -> dict[str, dict[str, object]]:
    """Parameters of every node, by its name."""
    if layout == "one node":
        return {_NODE: {"cameras": f"[{', '.join(cameras)}]"}}
    return {f"/{camera}": {} for camera in cameras}


def _prefixes(layout: Layout, cameras: Sequence[str]) -> dict[str, str]:
    """Prefix of the topics of every camera."""
    return {camera: f"{_NODE}/{camera}" if layout == "one node" else f"/{camera}" for camera in cameras}


def _command(node: str, parameters: Mapping[str, object]) -> list[str]:
    assigned = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    return [entry_point("detector"), "--ros-args", "-r", f"__node:={node.removeprefix('/')}", *assigned]
