"""Models swapped while a camera runs: no frame is lost track of, and each is from one configuration."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from support.colcon_workspace import REPOSITORY
from support.detector_process import DetectorProcess, as_arguments, detector_process, environment, is_balanced
from support.random_model import CLASS_NAMES, TINY, random_model, random_network
from support.served_node import messages_of
from vision_msgs.msg import Detection2DArray

from benchmark.process_memory import resident_mb
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.messages import stamp_ns

SWAPS = 20
RATE_HZ = 30
FRUIT = ("apple", "pear")


def written(folder: Path) -> tuple[Path, Path]:
    """Two models whose classes tell them apart."""
    animals, fruit = folder / "animals.safetensors", folder / "fruit.safetensors"
    write_safetensors(random_model(), animals)
    architecture = dataclasses.replace(TINY, classes=len(FRUIT))
    write_safetensors(Model(architecture, FRUIT, random_network(1, architecture).state_dict()), fruit)
    return animals, fruit


def swap(detector: DetectorProcess, path: Path) -> float:
    """Change the weights, and ask for the state until they are changed; the memory of the process in MB."""
    client = detector.observer.create_client(SetParametersAtomically, "/yolov5/set_parameters_atomically")
    detector.observer.wait_for(client.service_is_ready, "the service")
    request = SetParametersAtomically.Request(parameters=messages_of(weights=str(path)))
    change = client.call_async(request)
    while not change.done():
        assert detector.node.state() == "active"
    assert change.result().result.successful, change.result().result.reason
    detector.observer.destroy_client(client)
    return resident_mb(detector.process.process_id)


def status_at_rest(detector: DetectorProcess, messages: list[Detection2DArray]) -> dict[str, str]:
    """The first status without a frame under way, once as many detections have arrived as it counts."""
    statuses: list[dict[str, str]] = []

    def is_at_rest() -> bool:
        statuses.append(detector.status())
        return statuses[-1]["frames pending"] == "0"

    detector.observer.wait_for(is_at_rest, "the last frame")
    detected = int(statuses[-1]["frames detected"])
    detector.observer.wait_for(lambda: len(messages) >= detected, "the last detections")
    return statuses[-1]


@pytest.mark.long
def test_swaps_lose_no_frame_and_mix_no_models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(REPOSITORY / "config" / "shm.xml"))
    weights = written(tmp_path)
    parameters = {"weights": weights[0], "image_size": 320, "confidence_threshold": 0.0, "device": "cpu"}
    messages: list[Detection2DArray] = []
    sent_ns: list[int] = []

    def take_truth(truth: Detection2DArray) -> None:
        sent_ns.append(stamp_ns(truth.header))

    with detector_process(*as_arguments(parameters | {"max_detections": 5})) as detector:
        detector.bring_to("active")
        observer = detector.observer
        observer.create_subscription(Detection2DArray, "/yolov5/detections", messages.append, 1000)
        observer.create_subscription(Detection2DArray, "/camera/truth", take_truth, 1000)
        # With `auto` the node subscribes again once it knows the camera. While nobody subscribes, the camera
        # publishes its truth but no image; with a second subscriber there is an image for each truth.
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        observer.create_subscription(Image, "/yolov5/image_raw", lambda _: None, newest, raw=True)
        remap = ["--ros-args", "-r", "image_raw:=/yolov5/image_raw", "-p", f"rate:={RATE_HZ}.0"]
        with ChildProcess("camera", [entry_point("camera"), *remap], environment(detector.domain)) as camera:
            observer.wait_for(lambda: len(messages) > RATE_HZ, "a second of detections")
            used_mb = [swap(detector, weights[(number + 1) % 2]) for number in range(SWAPS)]
            assert camera.stop() == 0
        status = status_at_rest(detector, messages)
    assert is_balanced(status)
    # The ground truth of an image may itself be lost by this busy process, but none is ever added. A gap is
    # known by what follows it.
    first_ns, last_ns = (stamp_ns(messages[index].header) for index in (0, -1))
    accounted = sum(int(status[f"frames {end}"]) for end in ("received", "lost", "overtaken"))
    assert accounted >= sum(first_ns <= at_ns <= last_ns for at_ns in sent_ns)
    assert int(status["frames detected"]) == len(messages)
    classes = [[found.results[0].hypothesis.class_id for found in each.detections] for each in messages]
    names = {*map(frozenset, classes)}
    assert all(found <= set(FRUIT) or found <= set(CLASS_NAMES) for found in names)
    assert any(found & set(FRUIT) for found in names)
    assert any(found & set(CLASS_NAMES) for found in names)
    assert max(used_mb[-5:]) - max(used_mb[:5]) < 10
