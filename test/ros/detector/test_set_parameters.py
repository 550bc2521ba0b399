"""Parameters set while the node runs: applied as a whole or refused with the reason."""

from __future__ import annotations

import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rclpy.parameter import Parameter
from support.served_node import STATES, ServedNode, class_ids_of

from yolov5_lifecycle.settings.settings import SETTINGS


def test_live_settings_apply_from_the_next_frame(served: ServedNode) -> None:
    served.bring_to("active")
    assert class_ids_of(served.detect()) == ["cat"]
    assert served.set(confidence_threshold=0.95) == (True, "")
    assert class_ids_of(served.detect()) == []
    assert served.set(confidence_threshold=0.5, classes=["dog"]) == (True, "")
    assert class_ids_of(served.detect()) == []
    assert served.set(classes=["0"]) == (True, "")
    assert class_ids_of(served.detect()) == ["cat"]


def test_an_unknown_class_is_refused_with_a_suggestion(served: ServedNode) -> None:
    served.bring_to("active")
    done, reason = served.set(classes=["catt"])
    assert not done
    assert "'catt' is not a class" in reason
    assert "Did you mean 'cat'?" in reason
    assert served.get("classes") == []


def test_an_atomic_change_is_all_or_nothing(served: ServedNode) -> None:
    served.bring_to("active")
    done, reason = served.set(confidence_threshold=0.5, classes=["bird"])
    assert not done
    assert "bird" in reason
    assert served.get("confidence_threshold") == 0.25


MALFORMED = {
    "a type that does not exist": ParameterValue(type=42),
    "a deletion": ParameterValue(type=0),
    "a string for a number": ParameterValue(type=4, string_value="high"),
    "not a number": ParameterValue(type=3, double_value=float("nan")),
    "infinity": ParameterValue(type=3, double_value=float("inf")),
    "a huge list": ParameterValue(type=8, double_array_value=[0.5] * 100_000),
    "a huge string": ParameterValue(type=4, string_value="x" * 1_000_000),
}


@pytest.mark.parametrize("state", STATES)
def test_a_malformed_value_is_refused_in_every_state(served: ServedNode, state: str) -> None:
    served.bring_to(state)
    for description, value in MALFORMED.items():
        (result,) = served.set_one_by_one([ParameterMessage(name="confidence_threshold", value=value)])
        assert not result.successful, description
        assert result.reason, description
        assert served.get("confidence_threshold") == 0.25


@pytest.mark.parametrize("state", STATES)
def test_an_unknown_parameter_is_refused_in_every_state(served: ServedNode, state: str) -> None:
    served.bring_to(state)
    done, reason = served.set(confidence_treshold=0.5)
    assert not done
    assert "Did you mean 'confidence_threshold'?" in reason


@pytest.mark.parametrize(
    "values",
    [{"autostart": True}, {"bond_timeout": 4.0}, {"weights_dirs": ["/"]}, {"autostart": True, "lazy": False}],
    ids=str,
)
def test_a_setting_that_is_read_only_cannot_be_set(served: ServedNode, values: dict[str, object]) -> None:
    done, reason = served.set(**values)
    assert not done
    assert "read-only" in reason
    assert [served.get(name) for name in ("autostart", "weights_dirs", "lazy")] == [False, [], True]


@pytest.mark.parametrize("state", ["unconfigured", "active"])
def test_every_parameter_may_be_set_to_what_it_is(served: ServedNode, state: str) -> None:
    served.bring_to(state)
    foreign = ["use_sim_time", "start_type_description_service"]
    values = {name: served.get(name) for name in [*(setting.name for setting in SETTINGS), *foreign]}
    results = served.set_one_by_one(
        [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    )
    assert [result.reason for result in results if not result.successful] == []
    assert served.set(**values) == (True, "")
