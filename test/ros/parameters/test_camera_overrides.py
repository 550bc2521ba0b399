"""Parameters of single cameras: given at the start, set, deleted, described and dumped."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.parameter import Parameter
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.services import MAX_ITEMS
from yolov5_lifecycle.settings.camera_overrides import MAX_CAMERAS
from yolov5_lifecycle.settings.settings import SETTINGS, SETTINGS_BY_NAME, Settings

DEFAULTS = {
    setting.name: list(setting.default) if isinstance(setting.default, tuple) else setting.default
    for setting in SETTINGS
    if setting.per_camera
}


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    with ServedNode(prepare, parameters=["cameras:=[front, rear]"]) as served:
        yield served


def settings_of(served: ServedNode) -> Settings:
    return served.node._settings.settings()


def names(served: ServedNode) -> set[str]:
    return set(served.call("list_parameters", ListParameters.Request()).result.names)


def described(served: ServedNode, *names: str) -> list[ParameterDescriptor]:
    request = DescribeParameters.Request(names=names)
    return list(served.call("describe_parameters", request).descriptors)


# At the start


def test_every_parameter_is_logged_with_the_source_of_its_value(
    prepare: Preparations, tmp_path: Path
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(
        "/**:\n  ros__parameters:\n    cameras: [front, rear]\n    classes: [cat]\n"
        "    front: {max_rate: 5, classes: []}\n    rear.image_transport: compressed\n"
    )
    words = ["--ros-args", "--params-file", str(file), "-p", "rear.max_rate:=2.5"]
    with ServedNode(prepare, arguments=words) as served:
        assert served.set(**{"front.lazy": False, "rear.lazy": True}) == (True, "")
        assert served.set(**{"rear.lazy": None}) == (True, "")
        assert served.transition("configure")
        front, rear = map(settings_of(served).for_camera, ("front", "rear"))
        assert (front.max_rate, front.classes, front.lazy) == (5.0, (), False)
        assert (rear.max_rate, rear.classes, rear.image_transport) == (2.5, ("cat",), "compressed")
        served.wait_for_log("configured with")
        (table,) = (said for said in served.log if said.startswith("configured with"))
    rows = {line.split()[0]: line.split(maxsplit=2)[1:] for line in table.splitlines()[1:]}
    assert rows.keys() == SETTINGS_BY_NAME.keys() | {
        *("front.max_rate", "front.classes", "front.lazy", "rear.image_transport", "rear.max_rate")
    }
    assert rows["lazy"] == ["true", "default"]
    assert rows["front.max_rate"] == ["5.0", "given at the start"]
    assert rows["front.lazy"] == ["false", "set at run time"]


# At run time


def test_an_override_is_set_changed_and_deleted_while_the_node_detects(active: ServedNode) -> None:
    assert "front.max_rate" not in names(active)
    for value in (5, 7.5):
        assert active.set(**{"front.max_rate": value}) == (True, "")
        assert active.get("front.max_rate") == value
        assert settings_of(active).for_camera("front").max_rate == value
        assert settings_of(active).for_camera("rear") == Settings()
    for _ in range(2):  # what is not set may be deleted, too
        assert active.set(**{"front.max_rate": None}) == (True, "")
        assert "front.max_rate" not in names(active)
    assert settings_of(active).for_camera("front").max_rate == 0.0
    assert active.refusal(**{"side.max_rate": None}).startswith("side.max_rate: there is no such parameter")
    assert "front.classes: 'cta' is not a class of the model" in active.refusal(**{"front.classes": ["cta"]})
    assert settings_of(active).for_camera("front") == Settings()


# Reading


def test_an_override_is_described_like_its_setting(served: ServedNode) -> None:
    assert served.set(**{f"front.{name}": value for name, value in DEFAULTS.items()}) == (True, "")
    own = described(served, *(f"front.{name}" for name in DEFAULTS))
    for of_camera, plain in zip(own, described(served, *DEFAULTS), strict=True):
        assert of_camera.name == f"front.{plain.name}"
        assert of_camera.description.startswith(plain.description)
        assert "front" in of_camera.description
        assert f"; default {json.dumps(DEFAULTS[plain.name])}; " in plain.additional_constraints
        for field in ("type", "additional_constraints", "floating_point_range", "integer_range"):
            assert getattr(of_camera, field) == getattr(plain, field)


def test_every_override_of_the_most_cameras_may_be_set_read_and_deleted_at_once(
    served: ServedNode,
) -> None:
    cameras = [f"camera{number}" for number in range(MAX_CAMERAS)]
    overrides = {f"{camera}.{name}": value for camera in cameras for name, value in DEFAULTS.items()}
    assert not served.call("get_parameters", GetParameters.Request(names=["camera0.lazy"])).values
    assert served.set(**{"cameras": cameras, **overrides, "camera1.max_rate": 1}) == (True, "")
    assert settings_of(served).for_camera("camera1").max_rate == 1.0
    listed = sorted(names(served))
    assert len(listed) < MAX_ITEMS
    assert len(served.call("get_parameters", GetParameters.Request(names=listed)).values) == len(listed)
    assert len(described(served, *listed)) == len(listed)
    assert served.set(cameras=[], **dict.fromkeys(overrides)) == (True, "")
    assert settings_of(served) == Settings()


def dump(served: ServedNode) -> dict[str, Any]:
    """All parameters, as `ros2 param dump` writes them."""
    listed = sorted(names(served))
    values = served.call("get_parameters", GetParameters.Request(names=listed)).values
    tree: dict[str, Any] = {}
    for name, value in zip(listed, values, strict=True):
        *prefixes, last = name.split(".") if not name.startswith("qos") else [name]
        below = tree
        for prefix in prefixes:
            below = below.setdefault(prefix, {})
        found = Parameter.from_parameter_msg(ParameterMessage(name=name, value=value)).value
        below[last] = list(found) if hasattr(found, "__iter__") and not isinstance(found, str) else found
    return {"/yolov5": {"ros__parameters": tree}}


def test_a_node_started_with_a_dump_has_the_same_configuration(prepare: Preparations, tmp_path: Path) -> None:
    """Once the first has ended: a request would be answered by both nodes of this name."""
    file = tmp_path / "dump.yaml"
    changes = {"front.max_rate": 5.0, "front.classes": [], "rear.classes": ["dog"]}
    with ServedNode(prepare, parameters=["cameras:=[front, rear]"]) as served:
        assert served.set(**changes) == (True, "")
        dumped, settings = dump(served), settings_of(served)
    file.write_text(yaml.safe_dump(dumped))
    with ServedNode(prepare, arguments=["--ros-args", "--params-file", str(file)]) as restarted:
        assert settings_of(restarted) == settings
        assert dump(restarted) == dumped
        assert restarted.transition("configure")
