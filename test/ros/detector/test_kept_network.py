"""A thread that hangs keeps its network; the next session has another one, in every engine."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import Image
from support.camera_client import CameraClient
from support.colcon_workspace import REPOSITORY
from support.detector_process import scene_image
from support.runtime_names import EVERY_RUNTIME
from support.served_node import PATIENCE_S, ServedNode
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.prepared_model import prepare_model
from yolov5_lifecycle.runtimes.runtime import InferenceError

WEIGHTS = REPOSITORY / "weights" / "shapes.safetensors"
COUNT = 30


class BusyHang:
    """Makes the next detection go on and on, using its network all the while, until `end`.

    `rows` has every result of the network, `errors` what it raised.
    """

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.is_armed = threading.Event()
        self.entered = threading.Event()
        self.thread: threading.Thread | None = None
        self.rows: list[np.ndarray] = []
        self.errors: list[str] = []
        self._is_over = threading.Event()
        self._detect = Detector.detect
        patch.setattr(Detector, "detect", lambda *arguments: self._hang(*arguments))

    def end(self) -> None:
        self._is_over.set()
        if self.thread is not None:
            self.thread.join(PATIENCE_S)

    def _hang(self, detector: Detector, image: Any, selection: Any) -> Any:
        if self.is_armed.is_set():
            self.is_armed.clear()
            self.thread = threading.current_thread()
            frame = np.random.default_rng(1).integers(
                0, 256, (*detector.network_hw(image.size_hw), 3), np.uint8
            )
            try:
                while not self._is_over.is_set():
                    self.rows.append(detector.runtime(frame, "rgb").rows)
                    self.entered.set()
            except InferenceError as error:  # its network was closed, or another thread uses it
                self.errors.append(str(error))
        return self._detect(detector, image, selection)


@pytest.fixture
def hang(monkeypatch: pytest.MonkeyPatch) -> Iterator[BusyHang]:
    hang = BusyHang(monkeypatch)
    yield hang
    hang.end()


def boxes_of(message: Detection2DArray) -> list[tuple[float, ...]]:
    return [
        (found.bbox.center.position.x, found.bbox.center.position.y, found.results[0].hypothesis.score)
        for found in message.detections
    ]


@pytest.mark.long
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_detections_are_right_while_an_abandoned_thread_uses_its_network(
    runtime: str, hang: BusyHang, ros_domain: int
) -> None:
    parameters = [f"weights:={WEIGHTS}", "image_size:=320", f"runtime:={runtime}", "cameras:=[front, rear]"]
    with ServedNode(prepare_model, parameters=parameters) as served:
        front, rear = CameraClient(served, "front"), CameraClient(served, "rear")
        served.bring_to("active")
        shown: list[Image] = [scene_image(index) for index in range(3)]
        expected = [boxes_of(detected(served, rear, image)) for image in shown]
        assert all(expected)
        front.detect()
        hang.is_armed.set()
        served.wait_for(lambda: bool(front.send()) and hang.entered.is_set(), "the network to be kept")
        assert served.transition("deactivate")
        assert served.transition("activate")
        for index in range(COUNT):
            assert boxes_of(detected(served, rear, shown[index % 3])) == expected[index % 3]
        status = served.statuses()["rear"]
        assert ServedNode.counts_of({item.key: item.value for item in status.values})["failed"] == 0
        hang.end()
        assert len({rows.tobytes() for rows in hang.rows}) == 1
        assert all("closed" in error for error in hang.errors)
    assert served.escaped == []


def detected(served: ServedNode, camera: CameraClient, image: Image) -> Detection2DArray:
    """The detections of `camera` in `image`, sent until it is answered."""
    first_sec = camera.send(image)

    def is_answered() -> bool:
        if camera.detections and camera.detections[-1].header.stamp.sec >= first_sec:
            return True
        camera.send(image)
        return False

    served.wait_for(is_answered, f"detections of {camera.name}")
    return camera.detections[-1]
