"""Ground truth masks of the camera's scene, the executable as a process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from support.camera_process import camera_process
from support.detector_process import as_arguments
from support.grey_images import GREYS, grey_folder
from support.sighting import Sighting
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.ros.messages import image_of_message, stamp_ns
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.sources.scene import Scene, label_image

SEED = 4
SIZE_HW = (120, 160)
CAMERA = {"width": SIZE_HW[1], "height": SIZE_HW[0], "seed": SEED, "frame_id": "lens"}
TOPICS = {"/image_raw": Image, "/camera/truth": Detection2DArray, "/camera/ground_truth_masks": Image}


@pytest.fixture
def observer(ros_domain: int) -> Iterator[Observer]:
    with closing(Observer("client", domain=ros_domain)) as observer:
        yield observer


def _collected(observer: Observer, message_type: type, topic: str) -> dict[int, Any]:
    messages: dict[int, Any] = {}

    def take(message: Any) -> None:
        messages[stamp_ns(message.header)] = message

    observer.create_subscription(message_type, topic, take, 10)
    return messages


def _labels(message: Image) -> NDArray[np.uint16]:
    return np.frombuffer(bytes(message.data), "<u2").reshape(message.height, message.width)


@pytest.mark.long
def test_every_pixel_says_which_shape_of_the_truth_it_belongs_to(observer: Observer, ros_domain: int) -> None:
    received = [_collected(observer, message_type, topic) for topic, message_type in TOPICS.items()]

    def complete() -> set[int]:
        return set.intersection(*(set(messages) for messages in received))

    with camera_process(ros_domain, "--ros-args", *as_arguments(CAMERA)):
        observer.wait_for(lambda: len(complete()) >= 3, "messages on every topic")
    scene = Scene(SEED, SIZE_HW)
    index_of = {scene.frame(index)[0].tobytes(): index for index in range(1000)}
    for stamp in complete():
        image, truth, masks = (messages[stamp] for messages in received)
        shapes = scene.shapes(index_of[image_of_message(image).pixels.tobytes()])
        assert image.header == masks.header == truth.header
        assert (masks.encoding, masks.is_bigendian, masks.header.frame_id) == ("16UC1", 0, "lens")
        labels = _labels(masks)
        np.testing.assert_array_equal(labels, label_image([shape.outline() for shape in shapes], SIZE_HW))
        for label, box in enumerate(Sighting.of(truth).boxes_xyxy, start=1):
            rows, columns = np.nonzero(labels == label)
            filled = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            # The last 1.3 pixels of a star are narrower than one, and the next centre is up to 1 away.
            np.testing.assert_allclose(filled, box, atol=2.5)


@pytest.mark.long
def test_of_a_folder_no_masks_are_known(
    observer: Observer, ros_domain: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    images = _collected(observer, Image, "/image_raw")
    masks = _collected(observer, Image, "/camera/ground_truth_masks")
    folder = grey_folder(tmp_path_factory.mktemp("images"))
    with camera_process(ros_domain, "--ros-args", *as_arguments({"source": str(folder)})):
        observer.wait_for(lambda: len(images) >= len(GREYS), "images")
    assert not masks
