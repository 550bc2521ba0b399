"""A segmentation checkpoint as YOLOv5 writes it, from its file to the masks that the node publishes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from std_msgs.msg import Header
from support.random_model import random_frame
from support.runtime_names import EVERY_RUNTIME
from support.segmented_scene import MasksSubscriber, pixels
from support.served_node import ServedNode
from support.small_families import segmentation_checkpoint

from yolov5_lifecycle import load_model
from yolov5_lifecycle.detection.prepared_model import prepare_model
from yolov5_lifecycle.ros.messages import image_message

SIZE_HW = (75, 100)
SETTINGS = {"device": "cpu", "image_size": 96, "confidence_threshold": 0.3, "max_detections": 12}


@pytest.mark.end_to_end
@pytest.mark.usefixtures("ros_domain")
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_the_masks_of_a_checkpoint_are_published(runtime: str, tmp_path: Path) -> None:
    weights = tmp_path / "small-seg.pt"
    weights.write_bytes(segmentation_checkpoint())
    shown = random_frame(*SIZE_HW)
    detector = load_model(weights, runtime=runtime, **SETTINGS)  # type: ignore[arg-type]  # of any keyword
    detector.selection = dataclasses.replace(detector.selection, with_masks=True)
    found = detector(shown)
    expected = found.label_image()
    assert expected is not None
    assert len(np.unique(expected)) > 5, "a model of random weights shows something everywhere"
    values = SETTINGS | {"weights": weights, "runtime": runtime}
    parameters = [f"{name}:={value}" for name, value in values.items()]
    with ServedNode(prepare_model, parameters=parameters) as served:
        served.bring_to("active")
        masks = MasksSubscriber(served)
        message = image_message(shown, "bgr8", Header(frame_id="lens"))

        def have_come() -> bool:
            served.publish(message)
            return bool(masks.received)

        served.wait_for(have_come, "masks")
        served.wait_for(lambda: bool(served.detections), "detections")
        assert len(served.detections[0].detections) == len(found)
        np.testing.assert_array_equal(pixels(masks.received[0]), expected)
        assert served.values()["masks"] == "8 coefficients"
    assert served.escaped == []
