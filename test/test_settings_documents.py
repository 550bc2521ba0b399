"""The generated files agree with the settings."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tools.settings_documents import DOCUMENTS, yaml_file
from yolov5_lifecycle.settings.settings import SETTINGS, Settings, validated


@pytest.mark.parametrize(
    ("path", "text"), [pytest.param(*item, id=item[0].name) for item in DOCUMENTS.items()]
)
def test_the_committed_file_is_up_to_date(path: Path, text: Callable[[], str]) -> None:
    assert path.read_text() == text(), "run `make docs`"


def test_the_yaml_file_holds_the_defaults() -> None:
    parameters = yaml.safe_load(yaml_file())["/**"]["ros__parameters"]
    assert list(parameters) == [setting.name for setting in SETTINGS]
    assert validated(parameters) == Settings()


def parameters_of_the_schema() -> dict[str, Any]:
    schema = json.loads(next(text() for path, text in DOCUMENTS.items() if path.suffix == ".json"))
    parameters: dict[str, Any] = schema["additionalProperties"]["properties"]["ros__parameters"]
    return parameters


def test_the_schema_knows_every_setting() -> None:
    properties = parameters_of_the_schema()["properties"]
    assert list(properties) == [setting.name for setting in SETTINGS]
    assert properties["model_size"]["enum"] == ["n", "s", "m", "l", "x", "n6", "s6", "m6", "l6", "x6"]
    assert (properties["image_size"]["minimum"], properties["image_size"]["multipleOf"]) == (64, 32)


def test_the_schema_takes_any_other_name_for_a_camera_with_overrides() -> None:
    parameters = parameters_of_the_schema()
    of_camera = parameters["additionalProperties"]
    assert (of_camera["type"], of_camera["additionalProperties"]) == ("object", False)
    assert list(of_camera["properties"]) == [setting.name for setting in SETTINGS if setting.per_camera]
    assert all(
        of_camera["properties"][name] == parameters["properties"][name] for name in of_camera["properties"]
    )
    assert not any(re.search(name, "front") for name in parameters["patternProperties"])
    assert any(re.search(name, "front.max_rate") for name in parameters["patternProperties"])
