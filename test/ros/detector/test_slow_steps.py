"""Whatever a frame does, and at whatever step it hangs: the node answers, deactivates and detects again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from rclpy.lifecycle import LifecyclePublisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from support.depth_client import DEPTH_ON, SCENE
from support.depth_messages import camera_info_message, depth_message
from support.preparations import Preparations
from support.scripted_runtime import ScriptedRuntime
from support.segmented_scene import SIZE_HW, MasksSubscriber, SegmentingModel
from support.served_node import PATIENCE_S, ServedNode, class_ids_of, image

from yolov5_lifecycle.detection import detector
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.detector import outputs, pipeline
from yolov5_lifecycle.ros.detector.depth import DepthInput
from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S, abandoned
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker

STEPS: dict[str, tuple[Any, str]] = {
    "decoding": (messages, "image_of_message"),
    "inference": (ScriptedRuntime, "__call__"),
    "NMS": (detector, "select"),
    "tracking": (ByteTracker, "update"),
    "placing": (DepthInput, "place"),
    "masks": (Masks, "label_image"),
    "drawing": (pipeline, "annotate"),
    "compressing": (outputs, "compressed_image_message"),
    "publishing": (LifecyclePublisher, "publish"),
}
"""Where each step of a frame is: the owner of a function, and its name."""
QUICK = ("drawing", "publishing")
"""These run in every test run, the others are long."""
EVERY_STEP = [pytest.param(step, marks=() if step in QUICK else pytest.mark.long) for step in STEPS]


class HangingStep:
    """Makes the inference thread hang in a function from `begin` to `end`."""

    def __init__(self, owner: Any, name: str, patch: pytest.MonkeyPatch) -> None:
        self._is_armed = threading.Event()
        self.entered = threading.Event()
        self._release = threading.Event()
        patch.setattr(owner, name, self._hanging(getattr(owner, name)))

    def begin(self) -> None:
        self._is_armed.set()

    def end(self) -> None:
        self._is_armed.clear()
        self._release.set()

    def _hanging(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def step(*arguments: Any, **options: Any) -> Any:
            if self._is_armed.is_set() and threading.current_thread().name == "inference":
                self._is_armed.clear()
                self.entered.set()
                assert self._release.wait(10 * PATIENCE_S)
            return original(*arguments, **options)

        return step


@pytest.fixture(params=EVERY_STEP)
def step(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[HangingStep]:
    step = HangingStep(*STEPS[request.param], monkeypatch)
    yield step
    step.end()


class Robot:
    """An active node with a tracker, depth, masks and viewers, so that every step is taken."""

    def __init__(self, served: ServedNode) -> None:
        self.served = served
        client, newest = served.client, QoSProfile(depth=1)
        self._depth = client.create_publisher(Image, "/yolov5/depth/image_raw", 2)
        self._info = client.create_publisher(CameraInfo, "/yolov5/depth/camera_info", 2)
        self._masks = MasksSubscriber(served)
        self.seen: list[Image | CompressedImage] = []
        for kind, topic in ((Image, "image"), (CompressedImage, "image/compressed")):
            client.create_subscription(kind, f"/yolov5/{topic}", self.seen.append, newest)

    def send(self) -> None:
        self.served.images.publish(image(*SIZE_HW))
        self._depth.publish(depth_message(SCENE.depth_m, 0.0))
        self._info.publish(camera_info_message(0.0))

    def send_until(self, condition: Callable[[], bool], what: str) -> None:
        def is_met() -> bool:
            self.send()
            return condition()

        self.served.wait_for(is_met, what)


@pytest.fixture
def robot(prepare: Preparations) -> Iterator[Robot]:
    SegmentingModel(prepare)
    parameters = [*DEPTH_ON, "tracker:=bytetrack"]
    with ServedNode(prepare, parameters=parameters) as served:
        robot = Robot(served)
        served.bring_to("active")
        robot.send_until(lambda: len({type(message) for message in robot.seen}) == 2, "annotated images")
        yield robot
    assert served.escaped == []


def test_while_a_frame_hangs_services_answer_and_deactivate_proceeds(step: HangingStep, robot: Robot) -> None:
    served = robot.served
    step.begin()
    robot.send_until(step.entered.is_set, "the step to hang")
    deactivated = served.begin_transition("deactivate")
    assert served.state() == "active"
    assert not deactivated.done(), "the node answered only after it waited for the frame"
    served.wait_for(deactivated.done, "the answer to deactivate")
    assert deactivated.result().success
    served.wait_for_log(abandoned(REST_TIMEOUT_S))
    assert served.counts()["pending"] == 0
    step.end()
    assert served.transition("activate")
    before = len(served.detections)
    robot.send_until(lambda: len(served.detections) > before, "detections")
    assert class_ids_of(served.detections[-1])
