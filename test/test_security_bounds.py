"""The table of docs/security.md on what each input may cost agrees with the code."""

from __future__ import annotations

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY

import soak.__main__ as soak
from fuzz.targets import TARGETS
from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH
from yolov5_lifecycle.settings.class_thresholds import MAX_CLASS_NAME
from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME

PACKAGE = REPOSITORY / "yolov5_lifecycle"
NO_COST = {
    "detection.masks.MAX_LABEL",  # the largest number of 16 bits
    "detection.selection.MAX_EXPLAINED",  # what a message shows, like the next two
    "evaluation.curves.MAX_NAMED",
    "evaluation.curves.MAX_NUMBERED",
    "evaluation.matching.MAX_DETECTIONS",  # that of COCO
    "quantization.comparison.MAX_CARD_NOISE",  # how much int8 may differ, like the next two
    "quantization.comparison.MAX_INPUT_NOISE",
    "quantization.comparison.MAX_NOISE",
    "quantization.precision_choice.MAX_MAP_LOSS",
    "ros.demo.camera_figures.MAX_MEDIAN_ERROR_PERCENT",
    "ros.demo.camera_figures.MAX_SWITCHES",
    "ros.demo.several_cameras.MAX_RATE_HZ",
    "settings.settings.MAX_PARALLEL_FRAMES",  # the limit of a setting, which the table names
    "spatial.depth_image.MAX_DEPTH_M",
    "spatial.intrinsics.MAX_PX",
    "tracking.motion.MAX_MARGIN",
}
"""Public constants that limit neither a loop nor a buffer."""


def rows() -> list[tuple[str, str, str, str]]:
    """What comes from outside, bound, where and test of each row."""
    section = (REPOSITORY / "docs" / "security.md").read_text().partition("## What each input may cost\n")[2]
    table = section.partition("\n## ")[0].partition("| --- | --- | --- | --- |\n")[2]
    cells = [line.removeprefix("| ").removesuffix(" |").split(" | ") for line in table.splitlines() if line]
    return [(what, bound, where, tests) for what, bound, where, tests in cells]


ROWS = rows()
IDS = [row[0] for row in ROWS]


def names(text: str) -> list[str]:
    return re.findall(r"`([^`]+)`", text)


def written(value: float) -> set[str]:
    """How a limit may be written."""
    binary = {f"{int(value) >> bits:,} {unit}" for bits, unit in ((10, "KiB"), (20, "MiB"), (30, "GiB"))}
    return {f"{value:,.0f}"} | (binary if value >= 1024 else set())


def holds(bound: str, value: float) -> bool:
    return any(re.search(rf"(?<![\d,.]){re.escape(text)}(?![\d,]*\d)", bound) for text in written(value))


@cache
def functions_in(path: Path) -> set[str]:
    return {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}


def limit_of(name: str) -> float | None:
    """The number in the parameter or constant `name`; None for a function or class."""
    if name in SETTINGS_BY_NAME:
        setting = SETTINGS_BY_NAME[name]
        return setting.maximum if setting.max_length is None else setting.max_length
    module, _, attribute = name.rpartition(".")
    found = getattr(importlib.import_module(f"yolov5_lifecycle.{module}"), attribute)
    return found if isinstance(found, (int, float)) else None


@pytest.mark.parametrize(("bound", "where"), [row[1:3] for row in ROWS], ids=IDS)
def test_a_bound_of_the_table_is_that_of_the_code(bound: str, where: str) -> None:
    limits = {name: limit_of(name) for name in names(where)}
    assert limits
    assert [name for name, limit in limits.items() if limit is not None and not holds(bound, limit)] == []


@pytest.mark.parametrize("tests", [row[3] for row in ROWS], ids=IDS)
def test_a_test_of_the_table_exists(tests: str) -> None:
    functions, fuzzed, soaked = list[str](), list[str](), list[str]()
    for part in tests.split("; "):
        kind = part.partition(" ")[0]
        {"fuzz": fuzzed, "soak": soaked}.get(kind, functions).extend(names(part))
    assert functions
    for function in functions:
        path, _, name = function.partition("::")
        assert name in functions_in(REPOSITORY / path)
    assert set(fuzzed) <= TARGETS.keys()
    assert set(soaked) <= set(soak._NAMES)


def test_every_limit_of_the_code_is_in_the_table() -> None:
    told = {name for _, _, where, _ in ROWS for name in names(where)}
    defined = {
        f"{'.'.join(path.relative_to(PACKAGE).with_suffix('').parts)}.{name}"
        for path in PACKAGE.rglob("*.py")
        for name in re.findall(r"^(MAX_\w+)(?:: .*)? = ", path.read_text(), re.MULTILINE)
    }
    assert sorted(defined - told) == sorted(NO_COST)


def test_a_class_name_has_one_limit() -> None:
    assert MAX_CLASS_NAME == MAX_NAME_LENGTH
