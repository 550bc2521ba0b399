"""Regions of an image: how they are written, which are refused, and which points are in them."""

from __future__ import annotations

import math
import re

import cv2
import numpy as np
import pytest

from yolov5_lifecycle.images.region import MAX_CHARACTERS, MAX_POINTS, PointXY, Region


def circle(points: int) -> str:
    angles = [2 * math.pi * number / points for number in range(points)]
    return " ".join(f"{0.5 + 0.5 * math.cos(angle)},{0.5 + 0.5 * math.sin(angle)}" for angle in angles)


@pytest.mark.parametrize(
    ("text", "points_xy"),
    [
        pytest.param(" .5,0.25\t1.,0 \n1e-1,1 ", ((0.5, 0.25), (1, 0), (0.1, 1)), id="numbers-and-space"),
        pytest.param("0,0 0,1 1,1", ((0, 0), (0, 1), (1, 1)), id="the-other-way-round"),
    ],
)
def test_points_are_read_in_order(text: str, points_xy: tuple[PointXY, ...]) -> None:
    assert Region.parse(text).points_xy == points_xy


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(circle(MAX_POINTS), id="many-points"),
        pytest.param("0,0 0.3,0 0.7,0 1,0 1,1", id="points-on-a-line"),
        pytest.param("0,0 0.1,0.1 0.3,0 0.3,0.3 0.4,0 0.4,1", id="lines-on-one-line-that-are-apart"),
        pytest.param("0,0 0.7,0 0.7,0.1 0.1,0.1 0.1,0.2 0.7,0.2 0.7,0.3 0,0.3", id="a-fork"),
        pytest.param("0,0 1,1 0.5,1 0.5,0.8 0.4,0.8 0.4,1 0,1", id="a-notch-opposite-a-diagonal"),
    ],
)
def test_a_polygon_of_any_shape_has_the_points_that_it_has_for_opencv(text: str) -> None:
    region = Region.parse(text)
    assert len(region.points_xy) == len(text.split())
    outline = np.rint(1000 * np.array(region.points_xy)).astype(np.float32)
    tried = np.stack(np.meshgrid(np.arange(0, 1001, 50), np.arange(0, 1001, 50)), axis=-1).reshape(-1, 2)
    expected = [cv2.pointPolygonTest(outline, (float(x), float(y)), False) >= 0 for x, y in tried]
    np.testing.assert_array_equal(region.contains(tried / 1000), expected)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        pytest.param("", "has 0 points, a region has 3 to 64", id="nothing"),
        pytest.param(circle(MAX_POINTS + 1), "has 65 points", id="too-many-points"),
        pytest.param("0,0 " * 2000, f"has 8000 characters, more than {MAX_CHARACTERS}", id="too-long"),
        pytest.param("0 0 1 0 1 1", "has '0' as point 1", id="without-commas"),
        pytest.param("0, 0 1, 0 1, 1", "has '0,' as point 1: write x,y without a space", id="space"),
        pytest.param("0,0 nan,0 1,1", "has 'nan,0' as point 2", id="nan"),
        pytest.param("0,0 \u0661,0 1,1", "as point 2", id="other-digits"),
        pytest.param("0,0 a\x1b[31m,0 1,1", r"has 'a?[31m,0' as point 2", id="control-character"),
        pytest.param("0,0 640,0 640,480", "has point 2 at 640,0, outside the image", id="pixels"),
        pytest.param("0,0 1e999,0 1,1", "has point 2 at inf,0, outside the image", id="overflow"),
        pytest.param("0,0 1,0 1,1 0,0", "repeats its first point at the end", id="closed"),
        pytest.param("0,0 1,0 1,0 1,1", "has point 3 where point 2 is", id="repeated"),
        pytest.param("0,0 0.1,0.1 0.7,0.7", "has no area: its points lie on one line", id="on-one-line"),
        pytest.param("0,0 1,1 1,0 0,1", "cross or touch, from point to point: 1-2 and 3-4", id="bow-tie"),
        pytest.param("0,0 1,0 1,1 0.5,0 0,1", "1-2 and 3-4", id="touching"),
        pytest.param("0,1 1,1 1,0 0.5,1 0,0", "1-2 and 3-4", id="touching-from-below"),
        pytest.param("0,0 1,0 0.5,0 0.5,1", "1-2 and 2-3", id="turning-back"),
        pytest.param("0,0 0.5,0 0.5,1 1,0", "1-2 and 4-1", id="turning-back-at-the-end"),
    ],
)
def test_what_is_no_polygon_is_refused_with_the_reason(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=re.escape(reason)) as refusal:
        Region.parse(text)
    assert len(str(refusal.value)) < 250


def test_the_border_belongs_to_the_region_wherever_it_is() -> None:
    region = Region.parse("0.1,0.3 0.7,0.1 0.9,0.8 0.3,0.7")
    corners = np.array(region.points_xy)
    shares = np.linspace(0, 1, 101)[:, None]
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        on_line = begin + shares * (end - begin)
        assert region.contains(on_line).all()
        outwards = np.array([end[1] - begin[1], begin[0] - end[0]])
        assert not region.contains(on_line[1:-1] + 1e-4 * outwards / np.linalg.norm(outwards)).any()
