"""At whatever step and in however many inference streams frames hang: the node answers and goes on."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from rclpy.lifecycle import LifecyclePublisher
from sensor_msgs.msg import CompressedImage, Image
from support.camera_client import CameraClient, DepthClient, Viewer
from support.colcon_workspace import REPOSITORY
from support.detector_process import scene_image
from support.gate import Gate
from support.preparations import Preparations, prediction
from support.runtime_names import EVERY_RUNTIME
from support.scripted_runtime import ScriptedRuntime
from support.segmented_scene import SIZE_HW, MasksSubscriber, SegmentingModel
from support.served_node import ServedNode, class_ids_of
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.detection import detector
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.detection.prepared_model import prepare_model
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.detector import pipeline
from yolov5_lifecycle.ros.detector.depth import DepthInput
from yolov5_lifecycle.ros.detector.node import EXIT_ABANDONED_SESSIONS
from yolov5_lifecycle.ros.detector.session import MAX_ABANDONED_SESSIONS, REST_TIMEOUT_S
from yolov5_lifecycle.ros.observer import PATIENCE_S
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker

REST_S = 1.0
"""How long these nodes wait for a frame."""
ABANDONED = (
    f"inference did not end within {REST_S:g} s, so the node abandons the thread; the thread's memory stays "
    "in use"
)


@pytest.fixture
def hang() -> Iterator[Gate]:
    """Makes what it is put before hang while it is closed."""
    hang = Gate(is_open=True)
    yield hang
    hang.open()


STEPS: dict[str, tuple[Any, str]] = {
    "decoding": (messages, "image_of_message"),
    "inference": (ScriptedRuntime, "__call__"),
    "NMS": (detector, "select"),
    "tracking": (ByteTracker, "update"),
    "placing": (DepthInput, "place"),
    "masks": (Masks, "label_image"),
    "drawing": (pipeline, "annotate"),
    "compressing": (messages, "compressed_image_message"),
    "publishing": (LifecyclePublisher, "publish"),
}
"""Where each step of a frame is: the owner of a function, and its name."""
QUICK = ("drawing", "publishing")
"""These run in every test run, the others are long."""
EVERY_STEP = [pytest.param(step, marks=() if step in QUICK else pytest.mark.long) for step in STEPS]


@pytest.mark.parametrize("step", EVERY_STEP)
def test_while_a_frame_hangs_services_answer_and_deactivate_proceeds(
    step: str, hang: Gate, prepare: Preparations, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a tracker, depth, masks and viewers, so that every step is taken."""
    assert REST_TIMEOUT_S == 3.0
    owner, name = STEPS[step]
    monkeypatch.setattr(owner, name, hang.before(getattr(owner, name)))
    SegmentingModel(prepare)
    parameters = ["image_size:=128", "depth:=true", "tracker:=bytetrack"]
    with ServedNode(prepare, parameters=parameters, rest_timeout_s=REST_S) as served:
        camera = DepthClient(served, size_hw=SIZE_HW)
        raw, compressed = Viewer(camera), Viewer(camera, "image/compressed", CompressedImage)
        MasksSubscriber(camera)
        served.bring_to("active")

        def send_until(condition: Callable[[], bool], what: str) -> None:
            def is_met() -> bool:
                camera.send_depth()
                camera.send()
                return condition()

            served.wait_for(is_met, what)

        send_until(lambda: bool(raw.received and compressed.received), "annotated images")
        hang.close()
        send_until(hang.reached.is_set, "the step to hang")
        deactivated = served.begin_transition("deactivate")
        assert served.state() == "active"
        assert not deactivated.done(), "the node answered only after it waited for the frame"
        served.wait_for(deactivated.done, "the answer to deactivate")
        assert deactivated.result().success
        assert served.status().message == ABANDONED
        served.wait_for_log(ABANDONED)
        assert served.counts()["pending"] == 0
        hang.open()
        assert served.transition("activate")
        assert class_ids_of(camera.detect())


@pytest.mark.long
def test_a_hint_tells_that_a_frame_hangs(active: ServedNode, prepare: Preparations, hang: Gate) -> None:
    prepare.running.run = hang.before(prepare.run)
    hang.close()
    active.send_until(hang.reached.is_set, "inference to hang")
    hint = "s so far. If inference hangs, deactivate and activate the node"
    active.wait_for(lambda: hint in active.status().message, "the hint")
    active.wait_for_log(hint)


# Inference streams

NAMES = ("front", "rear", "left")


class Streams:
    """An active node with three cameras and two inference streams; `hold` lets both begin at once."""

    def __init__(self, served: ServedNode, prepare: Preparations) -> None:
        self.served = served
        self.prepare = prepare
        self.cameras = [CameraClient(served, name) for name in NAMES]
        self._gates: list[Gate] = []

    def hold(self) -> list[Gate]:
        """Return while frames of two cameras are in progress, with what lets each of them end.

        They are of any two cameras, because the first may have sent another one meanwhile.
        """
        whole, (alone, *of_streams) = self.prepare.running, [Gate() for _ in range(3)]
        self._gates += [alone, *of_streams]
        for runtime, gate in zip((whole, *whole.made_streams), (alone, *of_streams), strict=True):
            runtime.run = gate.before(lambda: prediction("cat", 0.9))
        first, *others = self.cameras
        self.served.wait_for(lambda: bool(first.send()) and alone.reached.is_set(), "a frame that is alone")
        self.served.wait_for(
            lambda: all(camera.send() and camera.counts()["pending"] for camera in others), "two that wait"
        )
        alone.open()
        for gate in of_streams:
            gate.wait_until_reached()
        return of_streams

    def release(self) -> None:
        for gate in self._gates:
            gate.open()


@contextmanager
def two_streams(prepare: Preparations, rest_timeout_s: float = REST_TIMEOUT_S) -> Iterator[Streams]:
    prepare.streams = 2
    parameters = [f"cameras:=[{', '.join(NAMES)}]"]
    with ServedNode(prepare, parameters=parameters, rest_timeout_s=rest_timeout_s) as served:
        streams = Streams(served, prepare)
        served.bring_to("active")
        yield streams
        streams.release()


def test_a_session_is_abandoned_as_a_whole_and_too_many_of_them_end_the_node(prepare: Preparations) -> None:
    with two_streams(prepare, rest_timeout_s=0.1) as streams:
        served = streams.served
        for session in range(1, MAX_ABANDONED_SESSIONS + 1):
            streams.hold()
            assert served.transition("deactivate")
            assert served.values()["abandoned threads"] == str(2 * session)
            assert served.node.exit_code is None
            assert served.transition("activate")
            assert [class_ids_of(camera.detect()) for camera in streams.cameras] == [["cat"]] * len(NAMES)
        streams.hold()
        assert served.transition("deactivate")
        assert served.node.exit_code == EXIT_ABANDONED_SESSIONS
        served.wait_for_log("exiting (code 4): inference hangs in 4 abandoned sessions, the limit is 3")


def test_after_the_answer_to_a_reload_no_camera_publishes_what_the_previous_model_found(
    prepare: Preparations,
) -> None:
    with two_streams(prepare, rest_timeout_s=PATIENCE_S) as streams:
        served = streams.served
        streams.cameras[1].size_hw = (48, 128)
        one, other = streams.hold()
        prepared = len(prepare.sizes_hw)
        prepare.class_names = ("star", "circle")
        reload = served.begin_set(image_size=320)
        served.wait_for(lambda: len(prepare.sizes_hw) > prepared, "another model")
        one.open()
        assert (served.state(), served.get("image_size")) == ("active", 640), "not before both have ended"
        assert not reload.done(), "a frame with the previous model is in progress"
        other.open()
        served.wait_for(reload.done, "the answer")
        assert reload.result().result.successful
        for camera in streams.cameras:
            camera.detect()
            published = [class_ids_of(message) for message in camera.detections]
            assert published == sorted(published), "a cat after a star"
            assert {*map(str, published)} == {"['cat']", "['star']"}, "each from one model"
    assert prepare.sizes_hw[-1] == [(48, 64), (48, 128), (48, 64)], "warmed up for each camera"


# A thread that hangs keeps its network; the next session has another one, in every engine

WEIGHTS = REPOSITORY / "weights" / "shapes.safetensors"
COUNT = 30


class BusyHang:
    """Makes the next detection go on and on, using its network all the while, until `end`.

    `rows` has every result of the network, `errors` what it raised.
    """

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.is_armed = threading.Event()
        self.entered = threading.Event()
        self.rows: list[bytes] = []
        self.errors: list[str] = []
        self._thread: threading.Thread | None = None
        self._is_over = threading.Event()
        self._detect = Detector.detect
        patch.setattr(Detector, "detect", lambda *arguments: self._hang(*arguments))

    def end(self) -> None:
        self._is_over.set()
        if self._thread is not None:
            self._thread.join(PATIENCE_S)

    def _hang(self, detector: Detector, image: Any, selection: Any) -> Any:
        if self.is_armed.is_set():
            self.is_armed.clear()
            self._thread = threading.current_thread()
            shape = (*detector.network_hw(image.size_hw), 3)
            frame = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
            try:
                while not self._is_over.is_set():
                    self.rows.append(detector.runtime(frame, "rgb").rows.tobytes())
                    self.entered.set()
            except InferenceError as error:  # its network was closed, or another thread uses it
                self.errors.append(str(error))
        return self._detect(detector, image, selection)


@pytest.fixture
def busy(monkeypatch: pytest.MonkeyPatch) -> Iterator[BusyHang]:
    busy = BusyHang(monkeypatch)
    yield busy
    busy.end()


def boxes_of(message: Detection2DArray) -> list[tuple[float, ...]]:
    return [
        (found.bbox.center.position.x, found.bbox.center.position.y, found.results[0].hypothesis.score)
        for found in message.detections
    ]


@pytest.mark.long
@pytest.mark.usefixtures("ros_domain")
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_detections_are_right_while_an_abandoned_thread_uses_its_network(
    runtime: str, busy: BusyHang
) -> None:
    parameters = [f"weights:={WEIGHTS}", "image_size:=320", f"runtime:={runtime}", "cameras:=[front, rear]"]
    with ServedNode(prepare_model, parameters=parameters, rest_timeout_s=0.1) as served:
        front, rear = CameraClient(served, "front"), CameraClient(served, "rear")
        served.bring_to("active")
        shown: list[Image] = [scene_image(index) for index in range(3)]
        expected = [boxes_of(rear.detect(image)) for image in shown]
        assert all(expected)
        front.detect()
        busy.is_armed.set()
        served.wait_for(lambda: bool(front.send()) and busy.entered.is_set(), "the network to be kept")
        assert served.transition("deactivate")
        assert served.transition("activate")
        for index in range(COUNT):
            assert boxes_of(rear.detect(shown[index % 3])) == expected[index % 3]
        assert rear.counts()["failed"] == 0
        busy.end()
        assert len(set(busy.rows)) == 1
        assert all("closed" in error for error in busy.errors)
