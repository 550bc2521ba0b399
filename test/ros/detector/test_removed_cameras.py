"""Cameras that are removed at the worst moment do not disturb the others."""

from __future__ import annotations

import gc
import threading
from typing import Any

import numpy as np
import pytest
from support.camera_client import CameraClient
from support.preparations import Preparations, prediction
from support.served_node import PATIENCE_S, ServedNode, class_ids_of

from yolov5_lifecycle.ros.detector.detector_camera import DetectorCamera
from yolov5_lifecycle.ros.detector.frame_failures import CameraFailures
from yolov5_lifecycle.ros.detector.managed_resources import ManagedResources
from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S


@pytest.fixture
def prepare(ros_domain: int) -> Preparations:
    return Preparations()


@pytest.mark.long
def test_cameras_that_are_removed_together_while_inference_hangs_abandon_one_thread(
    prepare: Preparations,
) -> None:
    hanging = ("front", "rear", "left", "right")
    hangs, released = threading.Event(), threading.Event()

    def hang() -> np.ndarray:
        hangs.set()
        assert released.wait(PATIENCE_S)
        return prediction("cat", 0.9)

    with ServedNode(prepare, parameters=[f"cameras:=[{', '.join(hanging)}, top]"]) as served:
        cameras = {name: CameraClient(served, name) for name in (*hanging, "top")}
        served.bring_to("active")
        for camera in cameras.values():
            camera.detect()
        cameras["top"].wait_for(cameras["top"].send())  # its last one: none of them may hang
        prepare.running.run = hang

        def all_wait() -> bool:
            for name in hanging:
                cameras[name].send()
            return all(cameras[name].counts()["pending"] for name in hanging)

        served.wait_for(lambda: bool(cameras["front"].send()) and hangs.is_set(), "a frame to hang")
        served.wait_for(all_wait, "frames of all to wait")
        assert served.set(cameras=["top"]) == (True, "")
        prepare.running.run = lambda: prediction("dog", 0.9)
        abandoned = "inference did not end within"
        served.wait_for_log("camera right removed: ")
        assert sum(f"{abandoned} {REST_TIMEOUT_S:g} s" in said for said in served.log) == 1
        assert class_ids_of(cameras["top"].detect()) == ["dog"]
        released.set()
    assert served.escaped == []


def test_a_node_is_configured_again_although_the_camera_of_a_qos_override_was_removed(
    prepare: Preparations,
) -> None:
    qos = "qos_overrides./yolov5/rear/detections.publisher.depth:=3"
    with ServedNode(prepare, parameters=["cameras:=[front, rear]", qos]) as served:
        served.bring_to("active")
        assert served.set(cameras=["front"]) == (True, "")
        assert [served.transition(label) for label in ("deactivate", "cleanup", "configure")] == [True] * 3
        assert served.set(cameras=["front", "rear"]) == (True, "")
        assert served.transition("activate")
        assert class_ids_of(CameraClient(served, "rear").detect()) == ["cat"]
    assert served.escaped == []


def test_a_success_that_a_removed_camera_reports_late_does_not_keep_a_failing_node_active(
    prepare: Preparations,
) -> None:
    """The frame of a camera is counted, so that the camera may be removed, before its success is reported."""
    with ServedNode(prepare, parameters=["cameras:=[front, rear]"]) as served:
        rear = CameraClient(served, "rear")
        served.bring_to("active")
        report_of_front = failures_of(served.node._resources, "front").succeeded
        assert served.set(cameras=["rear"]) == (True, "")
        report_of_front()
        prepare.running.run = fail

        def is_deactivated() -> bool:
            rear.send()
            return any("deactivated after 10 failed frames in a row" in said for said in served.log)

        served.wait_for(is_deactivated, "the node to deactivate itself")
    assert served.escaped == []


def failures_of(resources: ManagedResources, camera: str) -> CameraFailures:
    return resources._cameras[camera]._failures


def fail() -> np.ndarray:
    raise RuntimeError("the network fails")


def test_the_sizes_for_which_a_model_is_prepared_are_read_where_cameras_are_changed(
    prepare: Preparations,
) -> None:
    """In another thread cameras could come and go meanwhile, and the request be refused for that."""
    with ServedNode(prepare, parameters=["cameras:=[front, rear]"]) as served:
        served.bring_to("inactive")
        resources = served.node._resources
        cameras = resources._cameras = ThreadsThatRead(resources._cameras)
        assert served.transition("activate")
        assert cameras.threads == {served.serving_thread}


class ThreadsThatRead(dict[str, DetectorCamera]):
    """Cameras that know which threads look at all of them."""

    def __init__(self, cameras: dict[str, DetectorCamera]) -> None:
        super().__init__(cameras)
        self.threads: set[int] = set()

    def items(self) -> Any:
        self.threads.add(threading.get_ident())
        return super().items()


def test_nothing_is_kept_of_cameras_that_come_and_go(prepare: Preparations) -> None:
    with ServedNode(prepare, parameters=["cameras:=[front]"]) as served:
        served.bring_to("active")
        entities = served.node.default_callback_group.entities
        before = len(entities)
        for _ in range(5):
            assert served.set(cameras=["front", "rear"], **{"rear.lazy": False}) == (True, "")
            assert served.set(cameras=["front"]) == (True, "")

        def is_forgotten() -> bool:
            gc.collect()
            return len(entities) <= before

        served.wait_for(is_forgotten, "the endpoints of the removed cameras to be forgotten")
    assert served.escaped == []
