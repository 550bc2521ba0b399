"""The installed `detector` and `camera` as processes of their own, and what a client needs to try them."""

from __future__ import annotations

import os
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from numpy.typing import NDArray
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import ListParameters, SetParameters
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from support.worker import worker_domain
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point, isolated
from yolov5_lifecycle.ros.demo.demonstrations import boxes_xyxy, class_names
from yolov5_lifecycle.ros.messages import image_message, stamp_ns
from yolov5_lifecycle.ros.observer import Observer, RemoteLifecycleNode
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import SETTINGS
from yolov5_lifecycle.settings.synonyms import QOS_PREFIX
from yolov5_lifecycle.sources.scene import Scene
from yolov5_lifecycle.streaming.frame_statistics import Outcome

NODE = "/yolov5"
WEIGHTS = "package://yolov5_lifecycle/weights/shapes.safetensors"
PARAMETERS: dict[str, object] = {"weights": WEIGHTS, "image_size": 320, "device": "cpu"}
SEED = 8
SCENE = Scene(SEED, (240, 320))
MAX_PENDING = 2
"""Frames under way: one waits, one is in work."""
_ANSWER_S = 2.0
STEPS = {
    ("unconfigured", "inactive"): "configure",
    ("unconfigured", "active"): "configure",
    ("inactive", "unconfigured"): "cleanup",
    ("inactive", "active"): "activate",
    ("active", "unconfigured"): "deactivate",
    ("active", "inactive"): "deactivate",
}


@dataclass(frozen=True, eq=False)
class Sighting:
    """Classes, scores and boxes (n, 4), in pixels of the source, of the objects in one image."""

    class_names: tuple[str, ...]
    scores: tuple[float, ...]
    boxes_xyxy: NDArray[np.float64]

    @classmethod
    def of(cls, message: Detection2DArray) -> Sighting:
        scores = tuple(detection.results[0].hypothesis.score for detection in message.detections)
        return cls(tuple(class_names(message)), scores, boxes_xyxy(message))


class DetectorProcess:
    """The process, the node in it, and what was received from it so far. Made by `detector_process`."""

    def __init__(self, process: ChildProcess, observer: Observer, domain: int) -> None:
        self.process = process
        self.observer = observer
        self.domain = domain
        self.node = RemoteLifecycleNode(observer, NODE)
        self.detections: list[Detection2DArray] = []
        self._diagnostics: list[DiagnosticArray] = []
        observer.create_subscription(Detection2DArray, f"{NODE}/detections", self.detections.append, 10)
        observer.create_subscription(DiagnosticArray, "/diagnostics", self._diagnostics.append, 10)
        self._raw_transitions = observer.create_client(ChangeState, f"{NODE}/change_state")
        self._names = observer.create_client(ListParameters, f"{NODE}/list_parameters")
        self._raw_parameters = observer.create_client(SetParameters, f"{NODE}/set_parameters")
        self._images: Any = None
        self.node.wait_until_reachable()

    def transition(self, label: str = "", transition_id: int = 0) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition_id, label=label))
        return bool(self.observer.call(self._raw_transitions, request).success)

    def bring_to(self, state: str) -> None:
        """Walk there one transition at a time."""
        while (now := self.node.state()) != state:
            step = STEPS[now, state]
            assert self.transition(step), f"{step} was refused:\n{self.process.output}"

    def set_one_by_one(self, messages: Sequence[Any]) -> list[Any]:
        return list(
            self.observer.call(self._raw_parameters, SetParameters.Request(parameters=messages)).results
        )

    def status(self) -> dict[str, str]:
        """The values of the first diagnostics made from now on, their `message` and `level` (as `OK`)."""
        begun_ns = time.time_ns()

        def is_new() -> bool:
            return bool(self._diagnostics) and stamp_ns(self._diagnostics[-1].header) > begun_ns

        self.observer.wait_for(is_new, "diagnostics")
        (status,) = self._diagnostics[-1].status
        return {value.key: value.value for value in status.values} | {
            "message": status.message,
            "level": ("OK", "WARN", "ERROR", "STALE")[ord(status.level)],
        }

    def _matched_publisher(self) -> Any:
        if self._images is None:
            self._images = self.observer.create_publisher(Image, f"{NODE}/image_raw", 1)
        self.observer.wait_for(lambda: self._images.get_subscription_count() > 0, "the node to subscribe")
        return self._images

    def detect(self, image: Image) -> Detection2DArray:
        """What the node finds in `image`, sent until it is answered."""
        sent_s = float("-inf")

        def is_answered() -> bool:
            nonlocal sent_s
            if time.monotonic() - sent_s > _ANSWER_S:
                self._matched_publisher().publish(image)
                sent_s = time.monotonic()
            return any(message.header == image.header for message in self.detections)

        self.observer.wait_for(is_answered, "the detections of an image")
        return next(message for message in self.detections if message.header == image.header)

    def look(self, index: int = 0) -> Sighting:
        """What the node finds in image number `index` of the scene, sent now."""
        return Sighting.of(self.detect(scene_image(index)))

    def reset(self) -> None:
        """Unconfigured, with every parameter as it was at the start."""
        self.bring_to("unconfigured")
        listed = self.observer.call(self._names, ListParameters.Request()).result.names
        overrides = [name for name in listed if "." in name and not name.startswith(QOS_PREFIX)]
        assert all(r.successful for r in self.set_one_by_one([ParameterMessage(name=n) for n in overrides]))
        defaults = {s.name: s.default for s in SETTINGS if s.change is not Change.READ_ONLY}
        assert self.node.set_parameters(**defaults | PARAMETERS) == ""
        self.detections.clear()


@contextmanager
def detector_process(*arguments: str) -> Iterator[DetectorProcess]:
    """A detector in a domain of its own, started with these words behind --ros-args."""
    with (
        worker_domain() as domain,
        ChildProcess(
            "detector", [entry_point("detector"), "--ros-args", *arguments], environment(domain)
        ) as process,
        closing(Observer("client", domain=domain, check=process.check_running)) as observer,
    ):
        yield DetectorProcess(process, observer, domain)


@contextmanager
def camera_process(domain: int, *arguments: str) -> Iterator[ChildProcess]:
    with ChildProcess("camera", [entry_point("camera"), *arguments], environment(domain)) as process:
        yield process


def environment(domain: int) -> dict[str, str]:
    """For a process of this package's in `domain`."""
    return {"AMENT_PREFIX_PATH": sys.prefix} | isolated(os.environ, domain)


def as_arguments(parameters: Mapping[str, object]) -> list[str]:
    return [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]


def parameter_file(folder: Path, text: str) -> list[str]:
    """Arguments that name a file with `text`, the lines below ros__parameters."""
    path = folder / "parameters.yaml"
    path.write_text(f"yolov5:\n  ros__parameters:\n{textwrap.indent(text, '    ')}\n")
    return ["--params-file", str(path)]


def scene_image(index: int = 0) -> Image:
    """Image number `index` of the scene, stamped now."""
    seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
    header = Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id="lens")
    return image_message(SCENE.frame(index)[0], "rgb8", header)


def is_balanced(status: Mapping[str, str]) -> bool:
    """Whether every frame received is in exactly one count, and no more are under way than can be."""
    ends = [*(outcome.value for outcome in Outcome), "pending"]
    counts = [int(status[f"frames {end}"]) for end in ends]
    return int(status["frames received"]) == sum(counts) and 0 <= counts[-1] <= MAX_PENDING
