"""A setting is one field and what uses it; everything between them is derived."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from support.colcon_workspace import REPOSITORY

from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.selection import selection
from yolov5_lifecycle.settings.settings import SETTINGS, Settings
from yolov5_lifecycle.sources.scene import CLASS_NAMES

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


def test_every_setting_is_used() -> None:
    sources = (REPOSITORY / "yolov5_lifecycle").rglob("*.py")
    used = {word for path in sources if path != REPOSITORY / SETTINGS_FILE for word in _words(path)}
    assert [setting.name for setting in SETTINGS if setting.name not in used] == []


def test_a_setting_is_declared_once() -> None:
    declared = re.findall(r"^ +(\w+): Annotated\[", (REPOSITORY / SETTINGS_FILE).read_text(), re.MULTILINE)
    assert sorted(declared) == sorted(setting.name for setting in SETTINGS)


def test_a_selection_keeps_by_default_what_the_settings_do() -> None:
    assert selection(Settings(), CLASS_NAMES) == Selection()
