"""Lanes of a node: frames of its cameras at the same time, and changes between frames of all of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from support.camera_client import CameraClient
from support.preparations import Preparations, prediction
from support.served_node import PATIENCE_S, ServedNode, class_ids_of

from yolov5_lifecycle.ros.detector.session import MAX_ABANDONED_SESSIONS, REST_TIMEOUT_S

NAMES = ("front", "rear", "left")


class Lanes:
    """An active node with three cameras and two lanes, which `hold` lets begin at the same time."""

    def __init__(self, served: ServedNode, prepare: Preparations) -> None:
        self.served = served
        self.prepare = prepare
        self.front, self.rear, self.left = (CameraClient(served, name) for name in NAMES)
        self._released: list[threading.Event] = []

    def hold(self) -> tuple[threading.Event, threading.Event]:
        """Return while frames of two cameras are in progress, with what lets each of them end.

        They are of any two cameras, because the first may have sent another one meanwhile.
        """
        whole = self.prepare.running
        entered, release = threading.Event(), threading.Event()
        self._released.append(release)
        whole.run = self._held(entered, release)
        self.served.wait_for(lambda: bool(self.front.send()) and entered.is_set(), "a frame that is alone")
        of_lanes = [threading.Event(), threading.Event()]
        begun = [threading.Event(), threading.Event()]
        self._released += of_lanes
        for lane, is_begun, may_end in zip(whole.made_lanes, begun, of_lanes, strict=True):
            lane.run = self._held(is_begun, may_end)
        cameras = (self.rear, self.left)
        self.served.wait_for(
            lambda: all(camera.send() and camera.counts()["pending"] for camera in cameras), "two that wait"
        )
        release.set()
        assert all(each.wait(PATIENCE_S) for each in begun), "not at the same time"
        return of_lanes[0], of_lanes[1]

    def release(self) -> None:
        for event in self._released:
            event.set()

    def _held(self, entered: threading.Event, release: threading.Event) -> Callable[[], NDArray[np.float32]]:
        def run() -> NDArray[np.float32]:
            entered.set()
            assert release.wait(PATIENCE_S)
            return prediction("cat", 0.9)

        return run


@pytest.fixture
def rest_timeout_s() -> float:
    return REST_TIMEOUT_S


@pytest.fixture
def lanes(ros_domain: int, rest_timeout_s: float) -> Iterator[Lanes]:
    prepare = Preparations()
    prepare.lanes = 2
    parameters = [f"cameras:=[{', '.join(NAMES)}]"]
    with ServedNode(prepare, parameters=parameters, rest_timeout_s=rest_timeout_s) as served:
        lanes = Lanes(served, prepare)
        served.bring_to("active")
        for camera in (lanes.front, lanes.rear, lanes.left):
            camera.detect()
        yield lanes
        lanes.release()
    assert served.escaped == []


def test_frames_of_two_cameras_are_in_progress_at_the_same_time(lanes: Lanes) -> None:
    one, other = lanes.hold()
    one.set()
    other.set()
    for camera in (lanes.rear, lanes.left):
        assert class_ids_of(camera.detect()) == ["cat"]


def test_a_frame_that_hangs_in_a_lane_does_not_stop_the_other_cameras(lanes: Lanes) -> None:
    _, other = lanes.hold()
    other.set()
    cameras = (lanes.front, lanes.rear, lanes.left)
    before = [len(camera.detections) for camera in cameras]

    def others_go_on() -> bool:
        for camera in cameras:
            camera.send()
        new = [len(camera.detections) - count for camera, count in zip(cameras, before, strict=True)]
        return sorted(new)[1] >= 3

    lanes.served.wait_for(others_go_on, "three detections of each camera but the one that hangs")


@pytest.mark.parametrize("rest_timeout_s", [0.1])
def test_a_session_is_abandoned_as_a_whole_however_many_of_its_frames_hang(lanes: Lanes) -> None:
    served, sessions = lanes.served, MAX_ABANDONED_SESSIONS - 1
    for session in range(1, sessions + 1):
        lanes.hold()
        assert served.transition("deactivate")
        assert served.values()["abandoned threads"] == str(2 * session)
        assert served.transition("activate")
    assert 2 * sessions > MAX_ABANDONED_SESSIONS
    assert served.node.exit_code is None
    for camera in (lanes.front, lanes.rear, lanes.left):
        assert class_ids_of(camera.detect()) == ["cat"]


def test_after_the_answer_to_a_reload_no_camera_publishes_what_the_previous_model_found(lanes: Lanes) -> None:
    one, other = lanes.hold()
    prepared = len(lanes.prepare.sizes_hw)
    lanes.prepare.run = lambda: prediction("dog", 0.9)
    reload = lanes.served.begin_set(image_size=320)
    lanes.served.wait_for(lambda: len(lanes.prepare.sizes_hw) > prepared, "another model")
    one.set()
    assert lanes.served.state() == "active"
    assert not reload.done(), "a frame with the previous model is in progress"
    other.set()
    lanes.served.wait_for(reload.done, "the answer")
    assert reload.result().result.successful
    for camera in (lanes.front, lanes.rear, lanes.left):
        camera.detect()
        published = [class_ids_of(message) for message in camera.detections]
        assert published == sorted(published), "a cat after a dog"
        assert published[-1] == ["dog"]
