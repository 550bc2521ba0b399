"""Property: any parameter that can be sent becomes a setting or is refused with the reason."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.parameters.declaration import coerced, plain_values
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import SETTINGS, SETTINGS_BY_NAME, Settings, validated

INTEGERS = st.integers(-(2**63), 2**63 - 1)
TEXTS = st.text(max_size=8) | st.sampled_from(sorted({word for s in SETTINGS for word in s.choices}))
SCALARS = (st.booleans(), INTEGERS, st.floats(), TEXTS)
VALUES = st.one_of(st.none(), *SCALARS, *(st.lists(scalar, max_size=3) for scalar in SCALARS))
NAMES = st.sampled_from([setting.name for setting in SETTINGS])


def outcome(values: dict[str, object]) -> Settings | SettingsError:
    try:
        return validated(values)
    except SettingsError as error:
        return error


@given(NAMES, VALUES, st.booleans())
def test_any_parameter_becomes_a_setting_or_is_refused(name: str, value: object, may_be_unset: bool) -> None:
    if isinstance(value, list) and not value:
        parameter = Parameter(name, Parameter.Type.STRING_ARRAY, value)
    else:
        parameter = Parameter(name, value=value)
    meant = coerced(parameter, SETTINGS_BY_NAME, may_be_unset=may_be_unset)
    assert meant.name == name
    settings = outcome(plain_values([meant], SETTINGS_BY_NAME))
    if isinstance(settings, SettingsError):
        assert {problem.setting for problem in settings.problems} <= {name, "precision", "image_size"}
        assert all(len(problem.message) < 500 for problem in settings.problems)
        return
    assert validated(settings.model_dump()) == settings
    if isinstance(value, float):
        assert math.isfinite(value)
