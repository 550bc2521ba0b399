"""Camera and detector as processes: the ids of the detections are those of the true objects, renamed."""

from __future__ import annotations

import numpy as np
import pytest
from support.detector_process import NODE, SEED, DetectorProcess, as_arguments, environment
from support.sighting import Sighting
from vision_msgs.msg import Detection2DArray

from benchmark.tracking.figures import JudgedFrame, track_counts
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.messages import stamp_ns
from yolov5_lifecycle.sources.scene import CLASS_NAMES

MESSAGES = 45
CAMERA = {"width": 320, "height": 240, "seed": SEED, "rate": 5.0}
"""So slow that a busy machine loses hardly any image: between two of them no shape goes far."""


def ids_of(message: Detection2DArray) -> list[str]:
    return [detection.id for detection in message.detections]


def judged(truth: Detection2DArray, found: Detection2DArray) -> JudgedFrame:
    """An image with those of its detections that have an id."""
    tracked = [number for number, name in enumerate(ids_of(found)) if name]
    return JudgedFrame(
        truth_ids=[int(name) for name in ids_of(truth)],
        truth_boxes_xyxy=Sighting.of(truth).boxes_xyxy.astype(np.float32),
        track_ids=[ids_of(found)[number] for number in tracked],
        track_boxes_xyxy=Sighting.of(found).boxes_xyxy[tracked].astype(np.float32),
    )


@pytest.mark.long
def test_the_ids_of_the_scene_follow_its_shapes(detector: DetectorProcess) -> None:
    observer, found = detector.observer, detector.detections
    truths: dict[int, Detection2DArray] = {}

    def take_truth(message: Detection2DArray) -> None:
        truths[stamp_ns(message.header)] = message

    subscription = observer.create_subscription(Detection2DArray, "/camera/truth", take_truth, 10)
    # However slow the machine, no shape is away for longer.
    assert detector.node.set_parameters(tracker="bytetrack", track_timeout=60.0) == ""
    command = [
        entry_point("camera"),
        "--ros-args",
        "-r",
        f"image_raw:={NODE}/image_raw",
        *as_arguments(CAMERA),
    ]
    with ChildProcess("camera", command, environment(detector.domain)):
        observer.wait_for(lambda: bool(truths), "the camera's truth")
        detector.bring_to("active")
        observer.wait_for(lambda: len(found) >= MESSAGES, f"{MESSAGES} messages")
    observer.destroy_subscription(subscription)

    shapes = [str(number) for number in range(1, 7)]
    assert all(ids_of(message) == shapes for message in truths.values())
    assert {name for message in truths.values() for name in Sighting.of(message).class_names} == {
        *CLASS_NAMES
    }
    given = [[name for name in ids_of(message) if name] for message in found]
    assert all(len(set(names)) == len(names) for names in given)
    assert not any(given[0]), "an id needs two images"
    pairs = [(truths[stamp_ns(m.header)], m) for m in found if stamp_ns(m.header) in truths]
    assert len(pairs) >= MESSAGES / 2
    counts = track_counts([judged(*pair) for pair in pairs])
    assert counts.switches == 0
    assert counts.idf1 > 0.85
