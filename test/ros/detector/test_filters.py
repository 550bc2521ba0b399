"""Thresholds of classes, regions and sizes of boxes, changed while the node detects."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from support.camera_client import CameraClient
from support.depth_client import DEPTH_ON, DepthClient
from support.preparations import Preparations
from support.segmented_scene import PARAMETERS, SIZE_HW, MasksSubscriber, SceneCamera, SegmentingModel, pixels
from support.served_node import ServedNode, class_ids_of

from yolov5_lifecycle.detection.box_filter import BoxFilter
from yolov5_lifecycle.detection.draw import draw_regions
from yolov5_lifecycle.images.region import Region
from yolov5_lifecycle.ros.messages import image_of_message

# The box of the cat is 20 x 10 pixels around the middle of an image of 64 x 48, its score 0.9.
LEFT, RIGHT = "0,0 0.4,0 0.4,1 0,1", "0.4,0 1,0 1,1 0.4,1"
LOWER = "0,0.6 1,0.6 1,1 0,1"
CHANGES: list[tuple[dict[str, Any], list[str]]] = [
    ({"regions": [LEFT]}, []),
    ({"regions": [LEFT, RIGHT]}, ["cat"]),
    ({"ignore_regions": [RIGHT]}, []),
    ({"ignore_regions": [], "regions": [LOWER]}, []),
    ({"region_anchor": "foot"}, ["cat"]),
    ({"regions": [], "min_box_size": 21}, []),
    ({"min_box_size": 0.3}, ["cat"]),
    ({"max_box_size": 0.31}, []),
    ({"max_box_size": 20.0}, ["cat"]),
    ({"class_thresholds": ["cat: 0.95"]}, []),
    ({"class_thresholds": ["dog: 0.95"]}, ["cat"]),
    ({"confidence_threshold": 0.95}, []),
    ({"class_thresholds": ["0: 0.85"]}, ["cat"]),
]
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"regions": ["0,0 1,1"]}, "regions: ['0,0 1,1'] must be polygons, but entry 1 has 2 points"),
    ({"regions": [LEFT, "0,0 1,1 1,0 0,1"]}, "entry 2 has lines that cross or touch"),
    ({"ignore_regions": ["0,0 640,0 640,480"]}, "entry 1 has point 2 at 640,0, outside the image"),
    ({"regions": LEFT}, f'Did you mean ["{LEFT}"]?'),
    ({"region_anchor": "bottom"}, "'bottom' is not one of center, foot"),
    ({"min_box_size": 5.0, "max_box_size": 4.0}, "min_box_size: 5 is above max_box_size, 4."),
    ({"class_thresholds": ["cat"]}, "'cat' is not a class name or index, a colon and a number"),
    ({"class_thresholds": ["cat: 0.5", "0: 0.4"]}, "'cat' and '0' are the same class"),
    (
        {"class_thresholds": ["catt: 0.5"]},
        "'catt' is not a class of the model (cat, dog). Did you mean 'cat'?",
    ),
    ({"regions": [LEFT], "class_thresholds": ["cow: 0.5"]}, "'cow' is not a class of the model"),
]


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    """The node with a network input of the width of the images."""
    with ServedNode(prepare, parameters=["image_size:=64"]) as served:
        yield served
    assert served.escaped == []


def test_a_change_takes_effect_with_the_next_image(served: ServedNode) -> None:
    served.bring_to("active")
    assert class_ids_of(served.detect()) == ["cat"]
    for values, found in CHANGES:
        assert served.set(**values) == (True, ""), values
        assert class_ids_of(served.detect()) == found, values
    assert served.label_info().threshold == pytest.approx(0.95), "that of the classes without their own"


def test_a_wrong_value_is_refused_and_the_old_one_stays(served: ServedNode) -> None:
    served.bring_to("active")
    kept = {"regions": [RIGHT], "class_thresholds": ["dog: 0.95"], "max_box_size": 30.0}
    assert served.set(**kept) == (True, "")
    for values, reason in REFUSED:
        done, told = served.set(**values)
        assert not done, values
        assert reason in told, values
    assert {name: served.get(name) for name in kept} == kept
    assert class_ids_of(served.detect()) == ["cat"]


def test_a_threshold_of_an_unknown_class_is_refused_when_the_model_is_loaded(served: ServedNode) -> None:
    served.bring_to("inactive")
    assert served.set(class_thresholds=["cow: 0.5"]) == (True, "")
    assert not served.transition("activate")
    served.wait_for_log("class_thresholds: 'cow' is not a class of the model (cat, dog).")
    assert served.set(class_thresholds=["dog: 0.5"]) == (True, "")
    assert served.transition("activate")


def test_a_camera_may_have_its_own_regions(prepare: Preparations) -> None:
    parameters = ["image_size:=64", "cameras:=[front, rear]", f"regions:=['{RIGHT}']"]
    with ServedNode(prepare, parameters=parameters) as served:
        front, rear = (CameraClient(served, name) for name in ("front", "rear"))
        served.bring_to("active")
        assert [class_ids_of(camera.detect()) for camera in (front, rear)] == [["cat"], ["cat"]]
        assert served.set(**{"front.regions": [LEFT], "rear.class_thresholds": ["dog: 0.99"]}) == (True, "")
        assert [class_ids_of(camera.detect()) for camera in (front, rear)] == [[], ["cat"]]
        assert served.set(regions=[LEFT]) == (True, "")
        assert served.set(**{"front.regions": []}) == (True, "")
        assert [class_ids_of(camera.detect()) for camera in (front, rear)] == [["cat"], []]
        deletion = [Parameter("front.regions", Parameter.Type.NOT_SET).to_parameter_msg()]
        assert served.set_messages(deletion) == (True, "")
        assert [class_ids_of(camera.detect()) for camera in (front, rear)] == [[], []]
        done, reason = served.set(**{"front.regions": ["0,0"]})
        assert not done
        assert reason.startswith("front.regions: ['0,0'] must be polygons, but entry 1 has 1 points")
    assert served.escaped == []


def test_only_what_counts_has_a_place_in_space(prepare: Preparations) -> None:
    with ServedNode(prepare, parameters=DEPTH_ON) as served:
        depth = DepthClient(served, prepare)
        depth.begin()
        assert len(depth.place().detections) == 1
        assert served.set(ignore_regions=["0,0 1,0 1,1 0,1"]) == (True, "")
        assert depth.place().detections == []
    assert served.escaped == []


@pytest.fixture
def segmenting(prepare: Preparations) -> Iterator[ServedNode]:
    """An active node whose model finds a cat in the upper left and a dog in the lower right."""
    SegmentingModel(prepare)
    with ServedNode(prepare, parameters=PARAMETERS) as served:
        served.bring_to("active")
        yield served
    assert served.escaped == []


def test_masks_number_what_counts_and_the_annotated_image_shows_the_regions(segmenting: ServedNode) -> None:
    camera, masks, drawn = SceneCamera(segmenting), MasksSubscriber(segmenting), list[Image]()
    segmenting.client.create_subscription(Image, "/yolov5/image", drawn.append, QoSProfile(depth=10))
    camera.wait_for_masks(masks)
    assert segmenting.set(ignore_regions=["0,0 0.5,0 0.5,1 0,1"]) == (True, "")
    array, message = camera.segment(masks)
    assert class_ids_of(array) == ["dog"]
    labels = np.zeros(SIZE_HW, np.uint16)
    labels[64:88, 32:112] = 1  # also where the cat is in front of the dog
    np.testing.assert_array_equal(pixels(message), labels)
    segmenting.wait_for(lambda: any(one.header == array.header for one in drawn), "the annotated image")
    (seen,) = (image_of_message(one).pixels for one in drawn if one.header == array.header)
    expected = np.full((*SIZE_HW, 3), 114, np.uint8)
    ignored = Region.parse("0,0 0.5,0 0.5,1 0,1")
    draw_regions(expected, BoxFilter(ignore_regions=(ignored,)), line_px=1)
    np.testing.assert_array_equal(seen[:20], expected[:20])
    assert (expected[:20] != 114).any()
