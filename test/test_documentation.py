"""The examples in README and docs/ are understood, and messages name pages that there are."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from std_msgs.msg import Header
from support.colcon_workspace import PACKAGE, REPOSITORY
from support.depth_messages import camera_info_message, depth_message
from support.depth_scene import CAMERA
from support.pages import PAGES, README, blocks, typed
from support.segmented_scene import CAT_XYXY, DOG_XYXY, labels

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.settings.parameter_file import file_values
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS_BY_NAME, validated

OF_NAV2 = ("local_costmap",)
"""Nodes whose settings are not of this package."""


def test_a_page_that_the_package_names_is_there() -> None:
    files = [*REPOSITORY.glob(f"{PACKAGE}/**/*.py"), *REPOSITORY.glob("config/*")]
    named = {page for file in files for page in re.findall(r"\bdocs/[\w-]+\.md", file.read_text())}
    assert "docs/console.md" in named
    assert [page for page in named if not (REPOSITORY / page).is_file()] == []


def test_a_link_that_leads_nowhere_is_an_error_of_the_site_and_none_is_in_the_readme() -> None:
    assert "\nstrict: true\n" in (REPOSITORY / "mkdocs.yml").read_text()
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)]+)\)", README.read_text())]
    assert "docs/filters.md" in links
    assert [link for link in links if "://" not in link and not (REPOSITORY / link).exists()] == []


def test_a_page_of_the_site_loads_nothing_from_another_host() -> None:
    assert "\n  font: false" in (REPOSITORY / "mkdocs.yml").read_text()


def problems(page: Path, file: Path) -> Iterator[str]:
    """Commands that bash cannot parse, programs that are no Python, and settings that are refused."""
    run = subprocess.run(["bash", "-n"], input="\n".join(typed(page)), capture_output=True, text=True)
    yield from [run.stderr] if run.returncode or run.stderr else []
    for program in blocks(page, "python"):
        compile(program, page, "exec")
    for block in blocks(page, "yaml") if page != README else ():  # which shows how a file is refused
        file.write_text(block)
        try:
            (node,) = yaml.safe_load(block)
            if node in OF_NAV2:
                continue
            validated(file_values(file, f"/{node.lstrip('/')}".replace("**", "yolov5")))
        except ValueError as error:
            yield str(error)


def test_the_examples_of_a_page_are_understood(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    assert [f"{page.name}: {problem}" for page in PAGES for problem in problems(page, file)] == []


def test_the_programs_of_the_pages_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first of each page; those about depth with what a camera has sent."""
    monkeypatch.chdir(REPOSITORY)
    depth_m = np.full(CAMERA.size_hw, 4, np.float32)
    depth_m[80:140, 100:180] = 2
    board = Detections(np.array([[99, 79, 181, 141]], np.float32), np.ones(1, np.float32), np.array([0]))
    given = {"image": depth_message(depth_m, 7), "camera_info": camera_info_message(7), "detections": board}
    for page in ("docs/depth.md", "docs/points.md", "docs/tracking.md", "docs/python.md", "README.md"):
        exec(blocks(REPOSITORY / page, "python")[0], given)
    shown = capsys.readouterr().out
    expected = (", 2.0), size_xyz_m=(0.6", "0 [[", "('',)\n('1',)\n('1',)\n", "\nsquare 0.9")
    assert [part for part in expected if part not in shown] == []


def test_a_parameter_of_another_node_is_refused_with_the_name_that_the_page_gives() -> None:
    rows = re.findall(
        r"^\| (.*?) \| `(\w+)` \|", (REPOSITORY / "docs" / "migration.md").read_text(), re.MULTILINE
    )
    pairs = [
        (name, ours)
        for theirs, ours in rows
        if ours in SETTINGS_BY_NAME and "service" not in theirs
        for name in re.findall(r"`(\w+)`", theirs)
    ]
    assert ("half", "precision") in pairs
    # `model` is another setting for each of two nodes: one of them is given.
    assert {(name, SCHEMA.meant(name)) for name, _ in pairs} <= set(pairs)


def test_a_parameter_of_the_readme_has_its_true_default() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `(.*?)` \|", README.read_text(), re.MULTILINE)
    shown = {name: value for name, value in rows if name in SETTINGS_BY_NAME}
    assert "confidence_threshold" in shown
    assert validated({name: yaml.safe_load(value) for name, value in shown.items()}) == validated({})


def test_the_page_on_masks_counts_the_pixels_of_each_object(capsys: pytest.CaptureFixture[str]) -> None:
    boxes_xyxy = np.array([CAT_XYXY, DOG_XYXY], np.float32)
    found = Detections(boxes_xyxy, np.array([0.9, 0.8], np.float32), np.array([0, 1]))
    program: dict[str, Any] = {}
    exec(blocks(REPOSITORY / "docs" / "masks.md", "python")[0], program)
    array = messages.detection_array(found, ("cat", "dog"), Header())
    program["on_both"](array, messages.image_message(labels(), "16UC1", Header()))
    counts = [int((labels() == value).sum()) for value in (1, 2)]
    assert capsys.readouterr().out == f"cat  {counts[0]} pixels\ndog  {counts[1]} pixels\n"
