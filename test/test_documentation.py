"""What README and docs/ say of files, commands, parameters, topics and messages is true."""

from __future__ import annotations

import re
import runpy
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rclpy.parameter import Parameter
from std_msgs.msg import Header
from support.colcon_workspace import REPOSITORY, published_files
from support.pages import (
    MIGRATION,
    PAGES,
    README,
    TOPICS,
    blocks,
    spans,
    table,
    typed,
)
from support.preparations import Preparations
from support.segmented_scene import CAT_XYXY, DOG_XYXY, labels
from support.served_node import ServedNode

from yolov5_lifecycle.detection.class_filter import class_ids
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.camera.settings import CameraSettings
from yolov5_lifecycle.ros.parameters.declaration import value_of
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS, SETTINGS_BY_NAME, validated
from yolov5_lifecycle.sources.scene import CLASS_NAMES

POINTER = re.compile(r"\bdocs/[\w-]+\.md(?:#[\w-]+)?")
"""How a message, a comment or a docstring names a page or a section of a page."""


def settings_of(text: str) -> dict[str, Any]:
    """The parameters in a parameter file, in the types that the node gives them; QoS is not among them."""
    (node,) = yaml.safe_load(text).values()
    values: dict[str, Any] = {}
    for name, value in node["ros__parameters"].items():
        nested = value if isinstance(value, dict) else {}
        values |= {f"{name}.{below}": nested[below] for below in nested} or {name: value}
    return {
        name: value_of(Parameter(name, value=value), SCHEMA.find(name))
        for name, value in values.items()
        if not name.startswith("qos_overrides.")
    }


def dead_links(page: Path) -> Iterator[str]:
    for link in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        path, _, heading = link.partition("#")
        target = page.parent / path if path else page
        if "://" not in link and not (target.exists() and (not heading or heading in anchors(target))):
            yield f"link {link}"


def anchors(page: Path) -> list[str]:
    """The anchors of the headings of a page, as GitHub names them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return [re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings]


def test_a_page_that_the_code_names_exists() -> None:
    missing, found = [], 0
    # Tests make up pages, too.
    for file in (file for file in published_files() if file.suffix != ".md" and file.parts[0] != "test"):
        text = (REPOSITORY / file).read_text(errors="ignore")
        for path, _, heading in (pointer.partition("#") for pointer in POINTER.findall(text)):
            found += 1
            page = REPOSITORY / path
            if not page.is_file() or (heading and heading not in anchors(page)):
                missing.append(f"{file}: {path}#{heading}")
    assert found > 20
    assert missing == []


def unknown_names(page: Path) -> Iterator[str]:
    """What the page says in passing of targets, parameters and topics that are none."""
    text = "\n".join(spans(page))
    targets = re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
    named = set(re.findall(r"^make ([a-z-]+)", text, re.MULTILINE))
    yield from sorted(f"make {name}" for name in named - set(targets))
    asked = set(re.findall(r"ros2 param \w+ /\S+ ([a-z][\w.]*)", text))
    yield from sorted(f"parameter {name}" for name in asked if SCHEMA.find(name) is None)
    given = set(re.findall(r"-p (\w+):=", text)) - CameraSettings.model_fields.keys()
    yield from sorted(f"parameter {name}" for name in given if name not in SETTINGS_BY_NAME)
    remapped = {name.replace("/yolov5/", "~/") for name in re.findall(r"-r '?([~\w/]+):=", text)}
    yield from sorted(remapped - TOPICS - {"image_raw", "__node", "__ns"})


def broken_examples(page: Path) -> Iterator[str]:
    """Commands that bash cannot parse, programs that are no Python, and settings that are refused."""
    run = subprocess.run(["bash", "-n"], input="\n".join(typed(page)), capture_output=True, text=True)
    yield from [run.stderr] if run.returncode or run.stderr else []
    for program in blocks(page, "python"):
        compile(program, page, "exec")
    for block in blocks(page, "yaml") if page != README else ():
        validated(settings_of(block))


@pytest.mark.parametrize("problems", [dead_links, unknown_names, broken_examples])
def test_what_a_page_names_exists_and_its_examples_are_understood(
    problems: Callable[[Path], Iterator[str]],
) -> None:
    assert [f"{page.name}: {problem}" for page in PAGES for problem in problems(page)] == []


def test_a_parameter_of_the_readme_has_its_true_default() -> None:
    defaults = {setting.name: setting.default for setting in SETTINGS}
    for row in table(README, "Parameters"):
        name, shown = (cell.strip("`") for cell in row[:2])
        default = defaults[name]
        assert value_of(Parameter(name, value=yaml.safe_load(shown)), SETTINGS_BY_NAME[name]) == default, name


def test_the_line_for_apt_is_the_one_that_make_gives() -> None:
    machine = runpy.run_path(str(REPOSITORY / "requirements" / "check_machine.py"))
    assert machine["APT_LINE"] in typed(README)


@pytest.mark.usefixtures("ros_domain")
def test_the_readme_shows_the_refusal_of_its_wrong_file(tmp_path: Path) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(blocks(README, "yaml")[-1])
    with ServedNode(Preparations(), arguments=["--ros-args", "--params-file", str(file)]) as served:
        assert not served.transition("configure")
        assert served.status().message + "\n" == blocks(README, "text")[0]


def test_the_readme_shows_how_an_unknown_class_is_refused() -> None:
    with pytest.raises(ValueError, match="circel") as refused:
        class_ids(["circel"], CLASS_NAMES)
    assert f"Setting parameter failed: classes: {refused.value}" in README.read_text()


def test_the_page_on_masks_counts_the_pixels_of_each_object(capsys: pytest.CaptureFixture[str]) -> None:
    boxes_xyxy = np.array([CAT_XYXY, DOG_XYXY], np.float32)
    found = Detections(boxes_xyxy, np.array([0.9, 0.8], np.float32), np.array([0, 1]))
    program: dict[str, Any] = {}
    exec(blocks(REPOSITORY / "docs" / "masks.md", "python")[0], program)
    array = messages.detection_array(found, ("cat", "dog"), Header())
    program["on_both"](array, messages.image_message(labels(), "16UC1", Header()))
    counts = [int((labels() == value).sum()) for value in (1, 2)]
    assert capsys.readouterr().out == f"cat  {counts[0]} pixels\ndog  {counts[1]} pixels\n"


def test_a_name_that_replaces_that_of_another_node_exists() -> None:
    nodes = re.findall(r"^## (.*)$", MIGRATION.read_text(), re.MULTILINE)
    cells = [row[1] for node in nodes for row in table(MIGRATION, node)]
    named = {name for cell in cells for name in re.findall(r"`([^`]+)`", cell)}
    assert named <= {setting.name for setting in SETTINGS} | TOPICS | {"yolov5"}


def test_a_parameter_of_yolo_ros_is_refused_with_the_name_that_the_page_gives() -> None:
    settings = {setting.name for setting in SETTINGS}
    rows = [
        row
        for row in table(MIGRATION, "yolo_ros (mgonzs13/yolo_ros)")
        if row[1].strip("`") in settings and "service" not in row[0]
    ]
    assert len(rows) > 5
    for row in rows:
        for name in re.findall(r"`([^`]+)`", row[0]):
            assert SCHEMA.meant(name) == row[1].strip("`")
