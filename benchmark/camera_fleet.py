"""Detector processes for several cameras: one node for all of them, or a node for each.

This process must not import torch, whose libraries would count as shared with the detectors.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from std_srvs.srv import Trigger
from vision_msgs.msg import Detection2DArray

from benchmark import light_camera, misbehaving_camera
from benchmark.process_memory import proportional_mb, resident_mb
from benchmark.process_time import cpu_s
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point, isolated, own_domain
from yolov5_lifecycle.ros.messages import stamp_ns
from yolov5_lifecycle.ros.observer import Observer, RemoteLifecycleNode

Layout = Literal["one node", "a node each"]
LAYOUTS: tuple[Layout, Layout] = ("one node", "a node each")
_PROFILE = Path(__file__).parents[1] / "config" / "shm.xml"
_NODE = "/yolov5"
_SETTLING_S = 1.0
_QUEUE = 100


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
        processes: Sequence[ChildProcess],
        prefixes: Mapping[str, str],
        environment: Mapping[str, str],
    ) -> None:
        self._observer = observer
        self._processes = processes
        self._prefixes = prefixes
        self._environment = environment
        self._arrivals: list[Arrival] = []
        for camera, prefix in prefixes.items():
            observer.create_subscription(
                Detection2DArray, f"{prefix}/detections", partial(self._receive, camera), _QUEUE
            )

    def camera(self, name: str, image: Path, *, rate_hz: float, manner: str = "") -> ChildProcess:
        """A process that publishes `image`; with a `manner`, one that misbehaves that way."""
        script = [misbehaving_camera.__file__, manner] if manner else [light_camera.__file__]
        command = [sys.executable, *script, str(image), str(rate_hz), f"{self._prefixes[name]}/image_raw"]
        profile = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(_PROFILE)}
        return ChildProcess(f"camera {name}", command, {**self._environment, **profile})

    def wait_for(self, names: Sequence[str]) -> None:
        """Wait until images of all cameras in `names` are detected."""
        self._arrivals.clear()
        self._wait_for_arrivals(names)
        self._observer.work_for(_SETTLING_S)

    def watch(self, names: Sequence[str], duration_s: float) -> Passage:
        """Everything that arrives in `duration_s`, or until an image of each of `names` was detected."""
        begun_s, cpu_begun_s = time.monotonic(), self._cpu_s()
        self._arrivals.clear()
        self._observer.work_for(duration_s)
        self._wait_for_arrivals(names)
        arrivals = tuple(self._arrivals)
        return Passage(
            arrivals=arrivals,
            duration_s=time.monotonic() - begun_s,
            cpu_s=self._cpu_s() - cpu_begun_s,
            proportional_mb=sum(proportional_mb(process.process_id) for process in self._processes),
            resident_mb=sum(resident_mb(process.process_id) for process in self._processes),
        )

    def collect_every(self, period_s: float) -> None:
        """From now on, ask each detector to keep the next image every `period_s` seconds."""
        for prefix in self._prefixes.values():
            client = self._observer.create_client(Trigger, f"{prefix}/collect")
            self._observer.create_timer(period_s, partial(client.call_async, Trigger.Request()))

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
        for node in processes:
            _activate(observer, node)
        yield Fleet(observer, [*processes.values()], _prefixes(layout, cameras), environment)


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


def _activate(observer: Observer, name: str) -> None:
    node = RemoteLifecycleNode(observer, name)
    node.wait_until_reachable()
    for transition in ("configure", "activate"):
        if not node.change_state(transition):
            raise RuntimeError(f"the detector {name} refused to {transition}")
