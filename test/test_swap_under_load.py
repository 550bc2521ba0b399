"""Models swapped while a camera runs: no frame is lost track of, and each is from one configuration."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from detector_process import DetectorProcess, as_arguments, detector_process, environment, is_balanced
from machine_load import MachineLoad
from random_model import CLASS_NAMES, TINY, random_model, random_network
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.model import Model
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.sighting import stamp_ns
from yolov5_lifecycle.safetensors_file import write_safetensors

REPOSITORY = Path(__file__).parents[1]
SWAPS = 50
RATE_HZ = 30.0
FRUIT = ("apple", "pear")
LONGEST_GAP_S = 3 / RATE_HZ
SLOWEST_ANSWER_S = 0.05
TRIES = 3
OTHERS_CORES = 0.05
"""Times are judged only while other programs keep less than this busy: one burst of theirs is a gap here."""


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
    """Active, with the profile that carries whole pictures."""
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


@dataclasses.dataclass(frozen=True)
class Round:
    """The figures of many swaps."""

    longest_gap_s: float
    p99_answer_s: float
    others_cores: float

    @property
    def is_smooth(self) -> bool:
        return self.longest_gap_s < LONGEST_GAP_S and self.p99_answer_s < SLOWEST_ANSWER_S


class Watch:
    """What arrived, when, and what the camera sent, from the detector's first message on."""

    def __init__(self, detector: DetectorProcess) -> None:
        self.messages: list[Detection2DArray] = []
        self.arrivals_s: list[float] = []
        self.answers_s: list[float] = []
        self.resident_mb: list[float] = []
        self._sent_ns: list[int] = []
        self._detector = detector
        observer = detector.observer
        observer.create_subscription(Detection2DArray, "/yolov5/detections", self._take, 1000)
        observer.create_subscription(Detection2DArray, "/camera/truth", self._take_truth, 1000)
        self._setter = observer.create_client(SetParametersAtomically, "/yolov5/set_parameters_atomically")

    def swap(self, path: Path) -> None:
        """Change the weights, and ask for the state all the while."""
        weights = Parameter("weights", value=str(path)).to_parameter_msg()
        change = self._setter.call_async(SetParametersAtomically.Request(parameters=[weights]))
        while not change.done():
            begun_s = time.monotonic()
            assert self._detector.node.state() == "active"
            self.answers_s.append(time.monotonic() - begun_s)
            self._detector.observer.work_for(0.02)
        assert change.result().result.successful, change.result().result.reason
        self.resident_mb.append(_resident_mb(self._detector.process.process_id))

    def sent(self) -> int:
        """Pictures sent from the first that was detected to the last: a gap is known by what follows it."""
        first_ns, last_ns = (stamp_ns(self.messages[index].header) for index in (0, -1))
        return sum(first_ns <= sent_ns <= last_ns for sent_ns in self._sent_ns)

    def round(self, weights: tuple[Path, Path], camera: ChildProcess) -> Round:
        """Swap many times between the two."""
        processes = (os.getpid(), self._detector.process.process_id, camera.process_id)
        load = MachineLoad(processes)
        self.arrivals_s.clear()
        self.answers_s.clear()
        for swap in range(SWAPS):
            self.swap(weights[(swap + 1) % 2])
        longest_gap_s = max(later - earlier for earlier, later in pairwise(self.arrivals_s))
        p99_answer_s = sorted(self.answers_s)[int(0.99 * len(self.answers_s))]
        return Round(longest_gap_s, p99_answer_s, load.others_cores)

    def _take(self, message: Detection2DArray) -> None:
        self.messages.append(message)
        self.arrivals_s.append(time.monotonic())

    def _take_truth(self, truth: Detection2DArray) -> None:
        self._sent_ns.append(stamp_ns(truth.header))


def _resident_mb(process_id: int) -> float:
    """Memory of a process that is in RAM."""
    lines = Path(f"/proc/{process_id}/status").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith("VmRSS"))
    return int(kilobytes) / 1024


def _class_names(message: Detection2DArray) -> set[str]:
    return {detection.results[0].hypothesis.class_id for detection in message.detections}


@pytest.mark.timeout(300)
def test_swaps_lose_no_frame_mix_no_models_and_hold_nobody_up(
    detector: DetectorProcess, weights: tuple[Path, Path]
) -> None:
    watch = Watch(detector)
    command = [entry_point("camera"), "--ros-args", "-r", "image_raw:=/yolov5/image_raw"]
    rate = ["-p", f"rate:={RATE_HZ}"]
    with ChildProcess("camera", command + rate, environment(detector.domain)) as camera:
        detector.observer.wait_for(lambda: len(watch.arrivals_s) > RATE_HZ, "a second of detections")
        rounds = [watch.round(weights, camera)]
        while not rounds[-1].is_smooth and len(rounds) < TRIES:
            rounds.append(watch.round(weights, camera))
        assert camera.stop() == 0
    status = detector.status()
    assert is_balanced(status)
    # What the camera tells of each picture may itself be lost to this busy process, never added to.
    assert int(status["frames received"]) + int(status["frames lost"]) >= watch.sent()
    assert int(status["frames detected"]) == len(watch.messages)
    names = {frozenset(_class_names(message)) for message in watch.messages}
    assert all(found <= set(FRUIT) or found <= set(CLASS_NAMES) for found in names)
    assert any(found & set(FRUIT) for found in names)
    assert any(found & set(CLASS_NAMES) for found in names)
    assert max(watch.resident_mb[-10:]) - max(watch.resident_mb[:10]) < 10
    if not rounds[-1].is_smooth and rounds[-1].others_cores > OTHERS_CORES:
        pytest.skip(f"no time was judged, as other programs were busy: {rounds[-1]}")
    assert rounds[-1].is_smooth, rounds
