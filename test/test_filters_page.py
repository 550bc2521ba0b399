"""The page on what counts: its commands give its picture, its values and refusal are those of the code."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY
from support.pages import blocks, table, typed

from yolov5_lifecycle.detection.box_filter import BoxFilter
from yolov5_lifecycle.images.region import MAX_POINTS, MIN_POINTS
from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME, validated

PAGE = REPOSITORY / "docs" / "filters.md"
PICTURE = REPOSITORY / "docs" / "images" / "regions.jpg"
(COMMAND,) = [line for line in typed(PAGE) if line.startswith("detect_bag ")]


@pytest.mark.long
def test_the_picture_is_what_the_command_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("docs", "weights"):
        (tmp_path / folder).symlink_to(REPOSITORY / folder)
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(COMMAND)[1:]) == 0
    found = yaml.safe_load((tmp_path / "regions.jsonl").read_text())["detections"]
    assert sorted(one["class_name"] for one in found) == ["star", "star", "triangle"]
    corners = [one["box_xyxy"][:2] for one in found]
    drawn, shown = (without_labels(path, corners) for path in (tmp_path / "regions.jpg", PICTURE))
    assert drawn.shape == shown.shape
    assert np.abs(drawn - shown).mean() < 0.2
    assert PICTURE.stat().st_size < 150_000


def without_labels(picture: Path, corners: list[list[float]]) -> NDArray[np.int64]:
    """The pixels, black above the left corners of the boxes: OpenCV 4 and 5 draw text with other fonts."""
    pixels: NDArray[np.int64] = cv2.imread(str(picture)).astype(np.int64)
    for left, top in corners:
        pixels[max(round(top) - 28, 0) : round(top) + 3, round(left) - 3 : round(left) + 130] = 0
    return pixels


def test_the_table_names_each_parameter_with_its_default() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `(.*?)` \|", PAGE.read_text(), re.MULTILINE)
    filters = [
        "class_thresholds",
        "regions",
        "ignore_regions",
        "region_anchor",
        "min_box_size",
        "max_box_size",
    ]
    assert [name for name, _ in rows] == filters
    for name, default in rows:
        usual = SETTINGS_BY_NAME[name].default
        assert yaml.safe_load(default) == (list(usual) if isinstance(usual, tuple) else usual)


def test_the_parameter_file_is_valid() -> None:
    (text,) = blocks(PAGE, "yaml")
    values = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert len(validated(values).class_thresholds) == 3


def test_the_refusal_is_that_of_the_node() -> None:
    (refusal,) = blocks(PAGE, "text")
    with pytest.raises(SettingsError) as refused:
        validated({"regions": ("0,0 1,1 1,0 0,1",)})
    assert f"{refused.value}\n" == refusal


def test_the_limits_are_those_of_the_code() -> None:
    text = " ".join(PAGE.read_text().split())
    assert f"A region has {MIN_POINTS} to {MAX_POINTS} points" in text
    assert f"At most {SETTINGS_BY_NAME['regions'].max_length} regions" in text


def test_a_size_has_as_many_pixels_as_the_table_says() -> None:
    rows = table(PAGE, "Sizes")
    assert len(rows) == 4
    for value, pixels in rows:
        name, number = value.strip("`").split(": ")
        side = float(pixels.split()[0])
        smaller, larger = (np.array([[0, 0, side + by, 10]], np.float32) for by in (-0.2, 0.2))
        box_filter = replace(BoxFilter(), **{name: float(number)})  # type: ignore[arg-type]
        admitted = [bool(box_filter.admits(box, (720, 1280))[0]) for box in (smaller, larger)]
        assert admitted == ([False, True] if name == "min_box_size" else [True, False])
