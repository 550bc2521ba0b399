"""Parameters of single cameras: set, deleted, described, dumped and given at the start."""

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

from yolov5_lifecycle.ros.parameters.settings_parameters import SettingsParameters
from yolov5_lifecycle.ros.services import MAX_ITEMS
from yolov5_lifecycle.settings.camera_names import MAX_CAMERAS
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import SETTINGS, SETTINGS_BY_NAME, Settings

PER_CAMERA = [setting.name for setting in SETTINGS if setting.per_camera]
FRONT_AND_REAR = "cameras:=[front, rear]"


@pytest.fixture
def prepare(ros_domain: int) -> Preparations:
    return Preparations()


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    with ServedNode(prepare, parameters=[FRONT_AND_REAR]) as served:
        yield served
    assert served.escaped == []


def settings_of(served: ServedNode) -> Settings:
    return served.node._settings.settings()


def asked(values: dict[str, Any]) -> list[ParameterMessage]:
    """Parameters of a request; None deletes one."""
    return [
        Parameter(name, Parameter.Type.STRING_ARRAY, value).to_parameter_msg()
        if value == []
        else Parameter(name, value=value).to_parameter_msg()
        for name, value in values.items()
    ]


def change(served: ServedNode, values: dict[str, Any]) -> tuple[bool, str]:
    return served.set_messages(asked(values))


def names(served: ServedNode) -> set[str]:
    return set(served.call("list_parameters", ListParameters.Request()).result.names)


def described(served: ServedNode, *names: str) -> list[ParameterDescriptor]:
    request = DescribeParameters.Request(names=names)
    return list(served.call("describe_parameters", request).descriptors)


# At run time


def test_configure_lists_every_parameter_with_the_source_of_its_value(served: ServedNode) -> None:
    assert change(served, {"front.max_rate": 5, "max_rate": 9}) == (True, "")
    assert change(served, {"front.max_rate": None, "rear.max_rate": 3}) == (True, "")
    served.bring_to("inactive")
    served.wait_for_log("configured with")
    (told,) = (said for said in served.log if said.startswith("configured with"))
    listed = {line.split()[0]: line.rpartition("  ")[2] for line in told.splitlines()[1:]}
    changed = {"max_rate": "set at run time", "rear.max_rate": "set at run time", "cameras": "command line"}
    assert listed == dict.fromkeys(SETTINGS_BY_NAME, "default") | changed


@pytest.mark.parametrize("state", ["unconfigured", "inactive", "active"])
def test_an_override_is_set_changed_and_deleted(served: ServedNode, state: str) -> None:
    served.bring_to(state)
    assert "front.max_rate" not in names(served)
    for value in (5, 7.5):
        assert change(served, {"front.max_rate": value}) == (True, "")
        assert served.get("front.max_rate") == value
        assert settings_of(served).for_camera("front").max_rate == value
        assert settings_of(served).for_camera("rear") == Settings()
    assert change(served, {"front.max_rate": None}) == (True, "")
    assert "front.max_rate" not in names(served)
    assert settings_of(served).for_camera("front").max_rate == 0.0


def test_a_camera_and_its_overrides_may_be_added_in_one_request(served: ServedNode) -> None:
    values = {"side.max_rate": 5.0, "cameras": ["front", "side"], "side.classes": ["dog"]}
    assert change(served, values) == (True, "")
    settings = settings_of(served)
    assert settings.camera_names == ("front", "side")
    assert (settings.for_camera("side").max_rate, settings.for_camera("side").classes) == (5.0, ("dog",))


def test_the_overrides_of_a_removed_camera_may_be_deleted_with_it(served: ServedNode) -> None:
    assert change(served, {"front.max_rate": 5.0}) == (True, "")
    assert change(served, {"cameras": [], "front.max_rate": None}) == (True, "")
    assert settings_of(served) == Settings()


def test_deleting_an_override_that_is_not_set_changes_nothing(served: ServedNode) -> None:
    assert change(served, {"front.max_rate": None, "lazy": False}) == (True, "")
    assert change(served, {"front.max_rate": None}) == (True, "")
    assert "front.max_rate" not in names(served)


def test_an_empty_list_differs_from_an_override_that_is_not_set(served: ServedNode) -> None:
    assert change(served, {"classes": ["cat"], "front.classes": []}) == (True, "")
    assert served.get("front.classes") == []
    settings = settings_of(served)
    assert (settings.for_camera("front").classes, settings.for_camera("rear").classes) == ((), ("cat",))


def test_an_integer_is_taken_for_a_number_and_indices_for_names(served: ServedNode) -> None:
    assert change(served, {"front.confidence_threshold": 1, "front.classes": [0, 1]}) == (True, "")
    assert served.get("front.confidence_threshold") == 1.0
    assert served.get("front.classes") == ["0", "1"]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        pytest.param({"front.max_rate": -1.0}, "front.max_rate: -1.0 is not a number from 0", id="range"),
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
            {"front.max_rate": 5.0, "autostart": True}, "read-only parameter: autostart", id="read-only"
        ),
    ],
)
def test_a_wrong_override_is_refused_and_changes_nothing(
    served: ServedNode, values: dict[str, Any], reason: str
) -> None:
    served.bring_to("inactive")
    present, before = names(served), settings_of(served)
    done, told = change(served, values)
    assert not done
    assert reason in told
    assert (names(served), settings_of(served)) == (present, before)


def test_classes_of_a_camera_are_checked_with_the_running_model(served: ServedNode) -> None:
    served.bring_to("active")
    done, reason = change(served, {"front.classes": ["cta"]})
    assert not done
    assert reason.startswith("front.classes: 'cta' is not a class of the model")
    assert "Did you mean 'cat'?" in reason
    assert change(served, {"front.classes": [CLASS_NAMES[0]]}) == (True, "")


# What a proposal says, and its rollback


def proposed(parameters: SettingsParameters, **values: Any) -> Any:
    return parameters.propose(
        [
            Parameter.from_parameter_msg(message)
            for message in asked({n.replace("__", "."): v for n, v in values.items()})
        ]
    )


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        pytest.param({"front__max_rate": 5.0}, Change.LIVE, id="live"),
        pytest.param({"front__depth": True, "front__max_rate": 5.0}, Change.RESUBSCRIBE, id="resubscribe"),
        pytest.param({"front__depth": True, "parallel_frames": 2}, Change.RELOAD, id="reload"),
        pytest.param({"front__max_rate": None}, None, id="nothing"),
    ],
)
def test_a_proposal_knows_its_most_expensive_kind_of_change(
    served: ServedNode, values: dict[str, Any], kind: Change | None
) -> None:
    assert proposed(served.node._settings, **values).kind is kind


def test_a_stored_proposal_is_rolled_back_completely(served: ServedNode) -> None:
    parameters = served.node._settings
    assert change(served, {"front.max_rate": 5.0, "rear.classes": []}) == (True, "")
    before, present = parameters.settings(), names(served)
    proposal = proposed(parameters, cameras=["front", "rear", "side"], side__max_rate=3.0, rear__lazy=False)
    previous = parameters.present(proposal.parameters)
    assert parameters.store(proposal).successful
    assert parameters.settings() != before
    assert parameters.store(parameters.propose(previous)).successful
    assert (parameters.settings(), names(served)) == (before, present)


# Reading


@pytest.mark.parametrize("is_set", [False, True], ids=["inherited", "set"])
def test_every_override_is_described_set_or_not(served: ServedNode, is_set: bool) -> None:
    if is_set:
        assert change(served, {f"front.{name}": default(name) for name in PER_CAMERA}) == (True, "")
    for name in PER_CAMERA:
        (descriptor,), (of_node,) = described(served, f"front.{name}"), described(served, name)
        assert descriptor.name == f"front.{name}"
        assert descriptor.description.startswith(of_node.description)
        assert "front" in descriptor.description
        fields = ("type", "additional_constraints", "floating_point_range", "integer_range", "read_only")
        assert [getattr(descriptor, field) for field in fields] == [
            getattr(of_node, field) for field in fields
        ]


def default(name: str) -> Any:
    value = SETTINGS_BY_NAME[name].default
    return list(value) if isinstance(value, tuple) else value


@pytest.mark.parametrize("name", ["side.max_rate", "front.weights", "front.max_rte", "nothing"])
def test_a_name_that_is_no_parameter_is_not_described(served: ServedNode, name: str) -> None:
    assert described(served, name) == []
    assert described(served, "lazy", name) == []


def test_an_override_that_is_not_set_has_no_value(served: ServedNode) -> None:
    assert not served.call("get_parameters", GetParameters.Request(names=["front.max_rate"])).values


def test_every_override_of_the_most_cameras_may_be_set_and_read_in_one_request(served: ServedNode) -> None:
    cameras = [f"camera{number}" for number in range(MAX_CAMERAS)]
    overrides = {f"{camera}.{name}": default(name) for camera in cameras for name in PER_CAMERA}
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
