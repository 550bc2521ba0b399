"""Parameters given at the start."""

from __future__ import annotations

import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.parameter import Parameter
from support.preparations import Preparations
from support.served_node import ServedNode


@pytest.mark.parametrize(
    ("parameter", "fixed"),
    [
        pytest.param("confidence_threshold:=1.5", {"confidence_threshold": 0.5}, id="out-of-range"),
        pytest.param("lazy:=high", {"lazy": True}, id="wrong-type", marks=pytest.mark.long),
        pytest.param("confidence_treshold:=0.5", {"confidence_threshold": 0.5}, id="unknown-name"),
        pytest.param("model_size:=nano", {"model_size": "n"}, id="no-such-choice", marks=pytest.mark.long),
    ],
)
def test_a_bad_override_fails_configure_until_it_is_corrected(
    prepare: Preparations, parameter: str, fixed: dict[str, object]
) -> None:
    with ServedNode(prepare, parameters=[parameter]) as served:
        assert not served.transition("configure")
        assert parameter.partition(":=")[0] in served.status().message
        assert served.set(**fixed) == (True, "")
        assert served.transition("configure")
        assert served.escaped == []


def test_an_unknown_override_may_be_deleted(prepare: Preparations) -> None:
    with ServedNode(prepare, parameters=["colour:=red"]) as served:
        assert not served.transition("configure")
        (result,) = served.set_one_by_one([ParameterMessage(name="colour")])
        assert result.successful
        assert served.transition("configure")


def test_deleting_an_unknown_override_leaves_the_rest_of_the_request_to_be_set(prepare: Preparations) -> None:
    deletion = ParameterMessage(name="colour")
    with ServedNode(prepare, parameters=["colour:=red"]) as served:
        bad = Parameter("confidence_threshold", value=7.0).to_parameter_msg()
        assert not served.set_messages([deletion, bad])[0]
        assert not served.transition("configure")
        good = Parameter("confidence_threshold", value=0.7).to_parameter_msg()
        assert served.set_messages([deletion, good]) == (True, "")
        assert served.get("confidence_threshold") == 0.7
        assert served.transition("configure")


@pytest.mark.parametrize(
    ("parameter", "name", "value"),
    [
        pytest.param("confidence_threshold:=1", "confidence_threshold", 1.0, id="whole-number"),
        pytest.param("device:=0", "device", "0", id="device-index"),
        pytest.param("classes:=[]", "classes", [], id="empty-list"),
        pytest.param("classes:=[0, 1]", "classes", ["0", "1"], id="class-indices"),
        pytest.param("classes:=[cat]", "classes", ["cat"], id="class-names"),
        pytest.param("model_size:=n", "model_size", "n", id="n-that-yaml-takes-for-no"),
    ],
)
def test_an_override_is_taken_as_it_is_meant(
    prepare: Preparations, parameter: str, name: str, value: object
) -> None:
    with ServedNode(prepare, parameters=[parameter]) as served:
        assert served.transition("configure")
        assert served.get(name) == value
