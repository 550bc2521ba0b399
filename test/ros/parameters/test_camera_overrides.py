"""Parameters of single cameras: given at the start, set, deleted, described and dumped."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.parameter import Parameter
from support.preparations import CLASS_NAMES, Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.services import MAX_ITEMS
from yolov5_lifecycle.settings.camera_names import MAX_CAMERAS
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import SETTINGS, SETTINGS_BY_NAME, Settings

DEFAULTS = {
    setting.name: list(setting.default) if isinstance(setting.default, tuple) else setting.default
    for setting in SETTINGS
    if setting.per_camera
}


@pytest.fixture
def prepare(ros_domain: int) -> Preparations:
    return Preparations()


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    with ServedNode(prepare, parameters=["cameras:=[front, rear]"]) as served:
        yield served
    assert served.escaped == []


def settings_of(served: ServedNode) -> Settings:
    return served.node._settings.settings()


def parameters(values: dict[str, Any]) -> list[Parameter]:
    """Parameters of a request; None deletes one."""
    return [
        Parameter(name, Parameter.Type.STRING_ARRAY, value) if value == [] else Parameter(name, value=value)
        for name, value in values.items()
    ]


def change(served: ServedNode, values: dict[str, Any]) -> tuple[bool, str]:
    return served.set_messages([parameter.to_parameter_msg() for parameter in parameters(values)])


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
        assert change(served, {"front.lazy": False, "rear.lazy": True}) == (True, "")
        assert change(served, {"rear.lazy": None}) == (True, "")
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
    assert rows["front.max_rate"] == ["5.0", "parameter file"]
    assert rows["rear.max_rate"] == ["2.5", "command line"]
    assert rows["front.lazy"] == ["false", "set at run time"]


def test_an_override_applies_once_its_camera_is_added(prepare: Preparations) -> None:
    with ServedNode(prepare, parameters=["side.max_rate:=5", "classes:=[cat]", "side.classes:=[]"]) as served:
        assert served.set(cameras=["side"]) == (True, "")
        assert served.transition("configure")
        side = settings_of(served).for_camera("side")
        assert (side.max_rate, side.classes, served.get("side.max_rate")) == (5.0, (), 5.0)


def test_thousands_of_unknown_overrides_are_reported_soon(prepare: Preparations, tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    unknown = "".join(f"      confidence_treshold{number}: 0.5\n" for number in range(5000))
    file.write_text(f"/**:\n  ros__parameters:\n    cameras: [front]\n    front:\n{unknown}")
    with ServedNode(prepare, arguments=["--ros-args", "--params-file", str(file)]) as served:
        assert not served.transition("configure")
        assert "5000 problem(s)" in served.status().message
        assert served.set(lazy=False) == (True, "")


# At run time


@pytest.mark.parametrize("state", ["unconfigured", "active"])
def test_an_override_is_set_changed_and_deleted(served: ServedNode, state: str) -> None:
    served.bring_to(state)
    assert "front.max_rate" not in names(served)
    for value in (5, 7.5):
        assert change(served, {"front.max_rate": value}) == (True, "")
        assert served.get("front.max_rate") == value
        assert settings_of(served).for_camera("front").max_rate == value
        assert settings_of(served).for_camera("rear") == Settings()
    for _ in range(2):  # what is not set may be deleted, too
        assert change(served, {"front.max_rate": None}) == (True, "")
        assert "front.max_rate" not in names(served)
    assert settings_of(served).for_camera("front").max_rate == 0.0


def test_a_camera_and_its_overrides_are_added_and_removed_in_one_request(served: ServedNode) -> None:
    values = {"side.max_rate": 5.0, "cameras": ["front", "side"], "side.classes": ["dog"]}
    assert change(served, values) == (True, "")
    side = settings_of(served).for_camera("side")
    assert (side.max_rate, side.classes) == (5.0, ("dog",))
    assert change(served, {"cameras": [], "side.max_rate": None, "side.classes": None}) == (True, "")
    assert settings_of(served) == Settings()


def test_an_empty_list_is_set_and_integers_are_taken_for_numbers_and_names(served: ServedNode) -> None:
    values = {"classes": ["cat"], "front.classes": [], "front.max_rate": 1, "rear.classes": [0, 1]}
    assert change(served, values) == (True, "")
    assert served.get("front.classes") == []
    assert (served.get("front.max_rate"), served.get("rear.classes")) == (1.0, ["0", "1"])
    assert settings_of(served).for_camera("front").classes == ()


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        pytest.param({"side.max_rate": 5.0}, "add the camera to cameras, which has front, rear", id="new"),
        pytest.param({"side.max_rate": None}, "there is no such parameter", id="deletion"),
        pytest.param(
            {"cameras": ["rear"], "front.max_rate": 5.0}, "add the camera to cameras, which has", id="removed"
        ),
        pytest.param(
            {"track_high_threshold": 0.2, "rear.track_low_threshold": 0.21},
            "rear.track_low_threshold: 0.21 is above track_high_threshold, 0.2",
            id="contradiction-with-the-node",
        ),
        pytest.param(
            {"front.max_rate": 5.0, "autostart": True},
            "autostart: read-only: restart the node",
            id="read-only",
        ),
        pytest.param(
            {"front.classes": ["cta"]}, "front.classes: 'cta' is not a class of the model", id="class"
        ),
    ],
)
def test_a_wrong_override_is_refused_and_changes_nothing(
    served: ServedNode, values: dict[str, Any], reason: str
) -> None:
    served.bring_to("active")
    present, before = names(served), settings_of(served)
    done, told = change(served, values)
    assert not done
    assert reason in told
    assert (names(served), settings_of(served)) == (present, before)
    assert change(served, {"front.classes": [CLASS_NAMES[0]]}) == (True, "")


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        pytest.param({"front.depth": True, "front.max_rate": 5.0}, Change.RESUBSCRIBE, id="resubscribe"),
        pytest.param({"front.depth": True, "parallel_frames": 2}, Change.RELOAD, id="reload"),
        pytest.param({"front.max_rate": None}, None, id="nothing"),
    ],
)
def test_a_proposal_knows_its_most_expensive_kind_of_change(
    served: ServedNode, values: dict[str, Any], kind: Change | None
) -> None:
    assert served.node._settings.propose(parameters(values)).kind is kind


# Reading


@pytest.mark.parametrize("is_set", [False, True], ids=["inherited", "set"])
def test_every_override_is_described_set_or_not(served: ServedNode, is_set: bool) -> None:
    if is_set:
        assert change(served, {f"front.{name}": value for name, value in DEFAULTS.items()}) == (True, "")
    for name in DEFAULTS:
        (descriptor,), (of_node,) = described(served, f"front.{name}"), described(served, name)
        assert descriptor.name == f"front.{name}"
        assert descriptor.description.startswith(of_node.description)
        assert "front" in descriptor.description
        for field in ("type", "additional_constraints", "floating_point_range", "integer_range"):
            assert getattr(descriptor, field) == getattr(of_node, field)
    assert described(served, "lazy", "side.max_rate") == [], "no such camera"
    assert described(served, "front.weights") == [], "of the node alone"


def test_every_override_of_the_most_cameras_may_be_set_and_read_in_one_request(served: ServedNode) -> None:
    cameras = [f"camera{number}" for number in range(MAX_CAMERAS)]
    overrides = {f"{camera}.{name}": value for camera in cameras for name, value in DEFAULTS.items()}
    assert not served.call("get_parameters", GetParameters.Request(names=["camera0.lazy"])).values
    assert change(served, {"cameras": cameras, **overrides}) == (True, "")
    listed = sorted(names(served))
    assert len(listed) < MAX_ITEMS
    assert len(served.call("get_parameters", GetParameters.Request(names=listed)).values) == len(listed)
    assert len(described(served, *listed)) == len(listed)


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


def test_a_node_started_with_a_dump_has_the_same_configuration(
    served: ServedNode, prepare: Preparations, tmp_path: Path
) -> None:
    assert change(served, {"front.max_rate": 5.0, "front.classes": [], "rear.classes": ["dog"]}) == (True, "")
    file = tmp_path / "dump.yaml"
    file.write_text(yaml.safe_dump(dump(served)))
    with ServedNode(prepare, arguments=["--ros-args", "--params-file", str(file)]) as restarted:
        assert settings_of(restarted) == settings_of(served)
        assert dump(restarted) == dump(served)
        assert restarted.transition("configure")
