"""Parameters given at the start or set while the node runs: applied as a whole or refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from support.camera_client import CameraClient, DepthClient, Viewer
from support.preparations import Preparations
from support.served_node import ServedNode, class_ids_of, messages_of

from yolov5_lifecycle.detection.draw import draw_regions
from yolov5_lifecycle.images.region import BoxFilter, Region
from yolov5_lifecycle.ros.messages import image_of_message
from yolov5_lifecycle.ros.services import MAX_REASON
from yolov5_lifecycle.settings.settings import SETTINGS

# At the start


def test_an_override_is_taken_as_it_is_meant(prepare: Preparations) -> None:
    parameters = ("confidence_threshold:=1", "device:=0", "classes:=[0, 1]", "regions:=[]", "model_size:=n")
    meant: tuple[object, ...] = (1.0, "0", ["0", "1"], [], "n")  # YAML takes n for no
    with ServedNode(prepare, parameters=parameters) as served:
        assert served.transition("configure")
        assert tuple(served.get(parameter.partition(":=")[0]) for parameter in parameters) == meant


# While the node runs

MALFORMED = {
    "a type that does not exist": ParameterValue(type=42),
    "a deletion": ParameterValue(type=0),
    "a string for a number": ParameterValue(type=4, string_value="high"),
    "not a number": ParameterValue(type=3, double_value=float("nan")),
    "a huge list": ParameterValue(type=8, double_array_value=[0.5] * 100_000),
    "a huge string": ParameterValue(type=4, string_value="x" * 1_000_000),
    "many strings": ParameterValue(type=9, string_array_value=["a"] * 100_000),
    "a list beside a bool": ParameterValue(type=1, double_array_value=[1.0] * 125_000),
}


def test_what_is_malformed_or_unknown_is_refused_in_every_state(served: ServedNode) -> None:
    for label in ("", "configure", "activate"):
        assert not label or served.transition(label)
        for description, value in MALFORMED.items():
            (result,) = served.set_one_by_one([ParameterMessage(name="confidence_threshold", value=value)])
            assert not result.successful, description
            assert 0 < len(result.reason) < MAX_REASON, description
            assert served.get("confidence_threshold") == 0.25
    assert "Did you mean 'confidence_threshold'?" in served.refusal(confidence_treshold=0.5)


def test_every_parameter_may_be_set_to_what_it_is(served: ServedNode) -> None:
    foreign = ["use_sim_time", "start_type_description_service"]
    values = {name: served.get(name) for name in [*(setting.name for setting in SETTINGS), *foreign]}
    assert served.set(**values) == (True, "")
    served.bring_to("active")
    results = served.set_one_by_one(messages_of(**values))
    assert [result.reason for result in results if not result.successful] == []
    assert served.set(**values) == (True, "")


# The box of the cat is 20 x 10 pixels around the middle of an image of 64 x 48, its score 0.9.
LEFT, RIGHT = "0,0 0.4,0 0.4,1 0,1", "0.4,0 1,0 1,1 0.4,1"
CHANGES: list[tuple[dict[str, Any], list[str]]] = [
    ({"confidence_threshold": 0.95}, []),
    ({"confidence_threshold": 0.5, "classes": ["dog"]}, []),
    ({"classes": ["0"]}, ["cat"]),
    ({"regions": [LEFT]}, []),
    ({"regions": [LEFT, RIGHT]}, ["cat"]),
    ({"ignore_regions": [RIGHT]}, []),
    ({"ignore_regions": [], "regions": ["0,0.6 1,0.6 1,1 0,1"]}, []),
    ({"region_anchor": "foot"}, ["cat"]),
    ({"regions": [], "min_box_size": 21}, []),
    ({"min_box_size": 0.0, "max_box_size": 19.0}, []),
    ({"max_box_size": 20.0}, ["cat"]),
    ({"class_thresholds": ["cat: 0.95"]}, []),
    ({"confidence_threshold": 0.95, "class_thresholds": ["0: 0.85"]}, ["cat"]),
]
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"classes": ["catt"]}, "'catt' is not a class of the model (cat, dog). Did you mean 'cat'?"),
    ({"confidence_threshold": 0.5, "classes": ["bird"]}, "'bird' is not a class"),
    ({"regions": ["0,0 1,1"]}, "regions: ['0,0 1,1'] must be polygons, but entry 1 has 2 points"),
    ({"min_box_size": 35.0}, "min_box_size: 35 is above max_box_size, 30."),
    ({"regions": [LEFT], "class_thresholds": ["cow: 0.5"]}, "'cow' is not a class of the model"),
]


def test_a_change_takes_effect_with_the_next_image_and_a_wrong_one_changes_nothing(
    prepare: Preparations,
) -> None:
    with ServedNode(prepare, parameters=["image_size:=64"]) as served:
        served.bring_to("active")
        labels = served.label_info()
        assert labels.threshold == pytest.approx(0.25)
        assert [(label.class_id, label.class_name) for label in labels.class_map] == [(0, "cat"), (1, "dog")]
        assert class_ids_of(served.detect()) == ["cat"]
        for values, found in CHANGES:
            assert served.set(**values) == (True, ""), values
            assert class_ids_of(served.detect()) == found, values
        assert served.label_info().threshold == pytest.approx(0.95), "that of the classes without their own"
        kept = {"regions": [RIGHT], "class_thresholds": ["dog: 0.95"], "max_box_size": 30.0}
        assert served.set(confidence_threshold=0.25, **kept) == (True, "")
        before = {setting.name: served.get(setting.name) for setting in SETTINGS}
        for values, reason in REFUSED:
            assert reason in served.refusal(**values), values
        assert {setting.name: served.get(setting.name) for setting in SETTINGS} == before
        served.detect()


def test_a_camera_may_have_its_own_regions_which_hold_in_space_as_well(prepare: Preparations) -> None:
    parameters = ["image_size:=64", "cameras:=[front, rear]", f"regions:=['{RIGHT}']", "depth:=true"]
    with ServedNode(prepare, parameters=parameters) as served:
        front, rear = DepthClient(served, "front"), CameraClient(served, "rear")
        served.bring_to("active")
        assert len(front.place().detections) == 1
        assert served.set(**{"front.regions": [LEFT], "rear.class_thresholds": ["dog: 0.99"]}) == (True, "")
        assert front.place().detections == []
        assert class_ids_of(rear.detect()) == ["cat"]
        assert served.set(**{"regions": [LEFT], "front.regions": []}) == (True, "")
        assert [class_ids_of(camera.detect()) for camera in (front, rear)] == [["cat"], []]
        assert served.set_messages([ParameterMessage(name="front.regions")]) == (True, ""), "a deletion"
        assert class_ids_of(front.detect()) == []
        reason = served.refusal(**{"front.regions": ["0,0"]})
        assert reason.startswith("front.regions: ['0,0'] must be polygons, but entry 1 has 1 points")


def test_the_annotated_image_shows_the_regions(active: ServedNode) -> None:
    camera = CameraClient(active)
    viewer = Viewer(camera)
    viewer.begin()
    ignored = "0,0 0.5,0 0.5,1 0,1"
    assert active.set(ignore_regions=[ignored]) == (True, "")
    seen = image_of_message(viewer.of(camera.see().header)).pixels
    expected = np.full_like(seen, 114)
    draw_regions(expected, BoxFilter(ignore_regions=(Region.parse(ignored),)), line_px=1)
    np.testing.assert_array_equal(seen[:10], expected[:10])
    assert (expected[:10] != 114).any()
