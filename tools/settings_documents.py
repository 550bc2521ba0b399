"""Generates documents from the settings: the YAML file, its JSON schema and the reference page.

python -m tools.settings_documents
"""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import Any

from yolov5_lifecycle.settings.schema import Change, Setting
from yolov5_lifecycle.settings.settings import SETTINGS

REPOSITORY = Path(__file__).parents[1]
_SEVERAL_CAMERAS = """\
## Several cameras

Parameters marked *per camera* can be overridden for one camera, as `front.max_rate`; without an override the
camera uses the value of the node. [Several cameras](cameras.md) explains how to set and delete overrides, and
how to add and remove cameras while the node runs.
"""
_JSON_TYPES = {bool: "boolean", int: "integer", float: "number", str: "string", tuple: "array"}


def yaml_file() -> str:
    """config/yolov5.yaml: every setting with its default and description."""
    lines = [
        "# yaml-language-server: $schema=yolov5.schema.json",
        "# Every setting with its default. Generated from settings/settings.py by `make docs`.",
        "/**:",
        "  ros__parameters:",
    ]
    for setting in SETTINGS:
        comment = f"{setting.description} [{setting.allowed}; {_effect(setting)}]"
        lines += ["", *textwrap.wrap(comment, 110, initial_indent="    # ", subsequent_indent="    # ")]
        lines.append(f"    {setting.name}: {json.dumps(setting.default)}")
    lines += [
        "",
        "    # What is marked `per camera` can be overridden for one camera:",
        "    # front: {max_rate: 5.0}",
    ]
    return "\n".join(lines) + "\n"


def schema() -> str:
    """config/yolov5.schema.json: completion and validation in editors."""
    of_camera = {
        "type": "object",
        "description": "Overrides for the camera of this name.",
        "properties": {setting.name: _property(setting) for setting in SETTINGS if setting.per_camera},
        "additionalProperties": False,
    }
    parameters = {
        "type": "object",
        "properties": {setting.name: _property(setting) for setting in SETTINGS},
        # ROS's own parameters, and names with dots instead of nested ones
        "patternProperties": {"^(use_sim_time|qos_overrides)": {}, "[.]": {}},
        "additionalProperties": of_camera,
    }
    node = {"type": "object", "properties": {"ros__parameters": parameters}, "required": ["ros__parameters"]}
    document = {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Parameters of the yolov5_lifecycle detector",
        "type": "object",
        "additionalProperties": node,
    }
    return json.dumps(document, indent=2) + "\n"


def reference_page() -> str:
    """docs/parameters.md: one table."""
    rows = [
        f"| `{setting.name}` | {_type_word(setting)} | `{json.dumps(setting.default)}` | {setting.allowed} "
        f"| {_effect(setting)} | {setting.description} |"
        for setting in SETTINGS
    ]
    changes = [
        f"- **{change.value.partition(': ')[0]}**: {change.value.partition(': ')[2]}." for change in Change
    ]
    return "\n".join(
        [
            "# Parameters",
            "",
            "Generated from `yolov5_lifecycle/settings/settings.py` by `make docs`; of a running node,",
            "`ros2 param describe /yolov5 NAME` says the same. `config/yolov5.yaml` holds every default.",
            "",
            "| name | type | default | allowed | change | meaning |",
            "| --- | --- | --- | --- | --- | --- |",
            *rows,
            "",
            "What a change does while the node is active:",
            "",
            *changes,
            "",
            "Converted automatically: an integer to a number (`confidence_threshold: 1`), a device index",
            "(`device: 0` is `cuda:0`), a list of class indices (`classes: [0, 2]`), an empty list.",
            "",
            _SEVERAL_CAMERAS,
        ]
    )


DOCUMENTS = {
    REPOSITORY / "config" / "yolov5.yaml": yaml_file,
    REPOSITORY / "config" / "yolov5.schema.json": schema,
    REPOSITORY / "docs" / "parameters.md": reference_page,
}


def _effect(setting: Setting) -> str:
    effect = setting.change.value.partition(":")[0]
    return f"{effect}, per camera" if setting.per_camera else effect


def _type_word(setting: Setting) -> str:
    return {bool: "bool", int: "int", float: "double", str: "string", tuple: "string[]"}[setting.type]


def _property(setting: Setting) -> dict[str, Any]:
    rules: dict[str, Any] = {
        "type": _JSON_TYPES[setting.type],
        "description": setting.description,
        "default": setting.default,
    }
    if setting.type is tuple:
        rules["items"] = {"type": ["string", "integer"]}
    if setting.choices:
        rules["enum"] = setting.choices
    elif setting.type is str:
        rules["type"] = ["string", "integer"]  # an unquoted device index is accepted
    limits = {"minimum": setting.minimum, "maximum": setting.maximum, "multipleOf": setting.step}
    return rules | {name: value for name, value in limits.items() if value is not None}


def main() -> None:
    for path, text in DOCUMENTS.items():
        path.write_text(text())


if __name__ == "__main__":
    main()
