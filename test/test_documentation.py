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
from support.pages import PAGES, README, blocks, typed
from support.segmented_scene import CAT_XYXY, DOG_XYXY, labels

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.settings.parameter_file import file_values
from yolov5_lifecycle.settings.settings import validated


def test_a_page_that_the_package_names_is_there() -> None:
    files = [*REPOSITORY.glob(f"{PACKAGE}/**/*.py"), *REPOSITORY.glob("config/*")]
    named = {page for file in files for page in re.findall(r"\bdocs/[\w-]+\.md", file.read_text())}
    assert "docs/console.md" in named
    assert [page for page in named if not (REPOSITORY / page).is_file()] == []


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
            validated(file_values(file, f"/{node.lstrip('/')}".replace("**", "yolov5")))
        except ValueError as error:
            yield str(error)


def test_the_examples_of_a_page_are_understood(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    assert [f"{page.name}: {problem}" for page in PAGES for problem in problems(page, file)] == []


def test_the_page_on_masks_counts_the_pixels_of_each_object(capsys: pytest.CaptureFixture[str]) -> None:
    boxes_xyxy = np.array([CAT_XYXY, DOG_XYXY], np.float32)
    found = Detections(boxes_xyxy, np.array([0.9, 0.8], np.float32), np.array([0, 1]))
    program: dict[str, Any] = {}
    exec(blocks(REPOSITORY / "docs" / "masks.md", "python")[0], program)
    array = messages.detection_array(found, ("cat", "dog"), Header())
    program["on_both"](array, messages.image_message(labels(), "16UC1", Header()))
    counts = [int((labels() == value).sum()) for value in (1, 2)]
    assert capsys.readouterr().out == f"cat  {counts[0]} pixels\ndog  {counts[1]} pixels\n"
