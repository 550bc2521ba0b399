"""Models swapped while a camera runs: no frame is lost track of, and each is from one configuration."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from support.colcon_workspace import REPOSITORY
from support.detector_process import DetectorProcess, as_arguments, detector_process, environment, is_balanced
from support.random_model import CLASS_NAMES, TINY, random_model, random_network
from vision_msgs.msg import Detection2DArray

from benchmark.process_memory import resident_mb
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.messages import stamp_ns

pytestmark = pytest.mark.long

SWAPS = 20
RATE_HZ = 30.0
FRUIT = ("apple", "pear")


@pytest.fixture
def weights(tmp_path: Path) -> tuple[Path, Path]:
    """Two models whose classes tell them apart."""
    animals, fruit = tmp_path / "animals.safetensors", tmp_path / "fruit.safetensors"
    write_safetensors(random_model(), animals)
    architecture = dataclasses.replace(TINY, classes=len(FRUIT))
    write_safetensors(Model(architecture, FRUIT, random_network(1, architecture).state_dict()), fruit)
    return animals, fruit


@pytest.fixture
def detector(weights: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> Iterator[DetectorProcess]:
    """Active, with the profile that carries whole images."""
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(REPOSITORY / "config" / "shm.xml"))
    parameters = {
        "weights": weights[0],
        "image_size": 320,
        "confidence_threshold": 0.0,
        "max_detections": 5,
        "device": "cpu",
    }
    with detector_process(*as_arguments(parameters)) as detector:
        detector.bring_to("active")
        yield detector


class ProgressListener:
    """What arrived and what the camera sent, from the detector's first message on."""

    def __init__(self, detector: DetectorProcess) -> None:
        self.messages: list[Detection2DArray] = []
        self.resident_mb: list[float] = []
        self._sent_ns: list[int] = []
        self._detector = detector
        observer = detector.observer
        observer.create_subscription(Detection2DArray, "/yolov5/detections", self.messages.append, 1000)
        observer.create_subscription(Detection2DArray, "/camera/truth", self._take_truth, 1000)
        # With `auto` the node subscribes again once it knows the camera. While nobody subscribes, the camera
        # publishes its truth but no image; with a second subscriber there is an image for each truth.
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        observer.create_subscription(Image, "/yolov5/image_raw", lambda _: None, newest, raw=True)
        self._setter = observer.create_client(SetParametersAtomically, "/yolov5/set_parameters_atomically")

    def swap(self, path: Path) -> None:
        """Change the weights, and request the state until they are changed."""
        weights = Parameter("weights", value=str(path)).to_parameter_msg()
        change = self._setter.call_async(SetParametersAtomically.Request(parameters=[weights]))
        while not change.done():
            assert self._detector.node.state() == "active"
        assert change.result().result.successful, change.result().result.reason
        self.resident_mb.append(resident_mb(self._detector.process.process_id))

    def sent(self) -> int:
        """Images sent from the first detected one to the last: a gap is known by what follows it."""
        first_ns, last_ns = (stamp_ns(self.messages[index].header) for index in (0, -1))
        return sum(first_ns <= sent_ns <= last_ns for sent_ns in self._sent_ns)

    def _take_truth(self, truth: Detection2DArray) -> None:
        self._sent_ns.append(stamp_ns(truth.header))


def status_at_rest(detector: DetectorProcess, watch: ProgressListener) -> dict[str, str]:
    """The first status without a frame under way, once as many detections have arrived as it counts."""
    statuses: list[dict[str, str]] = []

    def is_at_rest() -> bool:
        statuses.append(detector.status())
        return statuses[-1]["frames pending"] == "0"

    detector.observer.wait_for(is_at_rest, "the last frame")
    detected = int(statuses[-1]["frames detected"])
    detector.observer.wait_for(lambda: len(watch.messages) >= detected, "the last detections")
    return statuses[-1]


def _class_names(message: Detection2DArray) -> set[str]:
    return {detection.results[0].hypothesis.class_id for detection in message.detections}


def test_swaps_lose_no_frame_and_mix_no_models(detector: DetectorProcess, weights: tuple[Path, Path]) -> None:
    watch = ProgressListener(detector)
    command = [entry_point("camera"), "--ros-args", "-r", "image_raw:=/yolov5/image_raw"]
    rate = ["-p", f"rate:={RATE_HZ}"]
    with ChildProcess("camera", command + rate, environment(detector.domain)) as camera:
        detector.observer.wait_for(lambda: len(watch.messages) > RATE_HZ, "a second of detections")
        for swap in range(SWAPS):
            watch.swap(weights[(swap + 1) % 2])
        assert camera.stop() == 0
    status = status_at_rest(detector, watch)
    assert is_balanced(status)
    # The ground truth of an image may itself be lost by this busy process, but none is ever added.
    accounted = sum(int(status[f"frames {end}"]) for end in ("received", "lost", "overtaken"))
    assert accounted >= watch.sent()
    assert int(status["frames detected"]) == len(watch.messages)
    names = {frozenset(_class_names(message)) for message in watch.messages}
    assert all(found <= set(FRUIT) or found <= set(CLASS_NAMES) for found in names)
    assert any(found & set(FRUIT) for found in names)
    assert any(found & set(CLASS_NAMES) for found in names)
    assert max(watch.resident_mb[-5:]) - max(watch.resident_mb[:5]) < 10
