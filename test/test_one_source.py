"""A setting is one field and what uses it; everything between them is derived."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY

from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.selection import selection
from yolov5_lifecycle.settings.schema import Setting
from yolov5_lifecycle.settings.settings import SETTINGS, Settings
from yolov5_lifecycle.sources.scene import CLASS_NAMES

SOURCES = sorted(
    [*(REPOSITORY / "yolov5_lifecycle").rglob("*.py"), REPOSITORY / "tools" / "settings_documents.py"]
)
# What carries settings from the user to their use knows none of them by name.
CARRIERS = {
    "yolov5_lifecycle/settings/schema.py",
    "yolov5_lifecycle/ros/parameters/declaration.py",
    "yolov5_lifecycle/ros/parameters/values.py",
    "yolov5_lifecycle/ros/parameters/settings_parameters.py",
    "yolov5_lifecycle/ros/detector/reconfiguration.py",
    "yolov5_lifecycle/ros/services.py",
    "yolov5_lifecycle/ros/detector/status.py",
    "tools/settings_documents.py",
}
SETTINGS_FILE = "yolov5_lifecycle/settings/settings.py"


def _words(path: Path) -> Iterator[str]:
    """Every identifier, keyword and text constant of a source file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, (ast.keyword, ast.arg)) and node.arg:
            yield node.arg
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


PLACES = {str(path.relative_to(REPOSITORY)): set(_words(path)) for path in SOURCES}
assert PLACES.keys() >= CARRIERS


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.name)
def test_a_setting_occurs_where_it_is_declared_and_where_it_is_used(setting: Setting) -> None:
    places = {name for name, words in PLACES.items() if setting.name in words}
    assert SETTINGS_FILE in places
    assert places - {SETTINGS_FILE}, "a setting that nobody uses"
    if setting.name != "cameras":  # also what the objects are called that carriers know
        assert not places & CARRIERS


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.name)
def test_a_setting_is_declared_once(setting: Setting) -> None:
    declared = [
        line
        for line in (REPOSITORY / SETTINGS_FILE).read_text().splitlines()
        if line.strip().startswith(f"{setting.name}: Annotated[")
    ]
    assert len(declared) == 1


def test_a_selection_keeps_by_default_what_the_settings_do() -> None:
    assert selection(Settings(), CLASS_NAMES) == Selection()
