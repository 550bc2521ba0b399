"""Which boxes count: their place and their size."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from yolov5_lifecycle.detection.class_filter import selection_of
from yolov5_lifecycle.images.region import BoxFilter, Region
from yolov5_lifecycle.settings.settings import validated

SIZE_HW = (200, 400)
WHOLE = Region.parse("0,0 1,0 1,1 0,1")
LEFT = Region.parse("0,0 0.5,0 0.5,1 0,1")
LOWER = Region.parse("0,0.5 1,0.5 1,1 0,1")
CORNER = Region.parse("0.75,0.75 1,0.75 1,1 0.75,1")


def admitted(box_xyxy: tuple[float, ...], **settings: Any) -> bool:
    """Whether the box counts in an image 400 pixels wide and 200 high."""
    (counts,) = BoxFilter(**settings).admits(np.array([box_xyxy], np.float32), SIZE_HW)
    return bool(counts)


@pytest.mark.parametrize(
    ("box_xyxy", "settings", "counts"),
    [
        pytest.param((10, 10, 20, 20), {}, True, id="no-filter"),
        pytest.param((310, 10, 320, 20), {"regions": (LEFT,)}, False, id="outside"),
        pytest.param((150, 10, 250, 20), {"regions": (LEFT,)}, True, id="centre-on-the-border"),
        pytest.param((152, 10, 250, 20), {"regions": (LEFT,)}, False, id="centre-just-outside"),
        pytest.param((310, 110, 320, 190), {"regions": (LEFT, LOWER)}, True, id="in-one-of-two"),
        pytest.param((310, 10, 320, 20), {"ignore_regions": (LEFT,)}, True, id="not-ignored"),
        pytest.param(
            (350, 170, 360, 180), {"regions": (LOWER,), "ignore_regions": (CORNER,)}, False, id="both"
        ),
        pytest.param((10, 20, 20, 130), {"regions": (LOWER,), "region_anchor": "foot"}, True, id="foot-in"),
        pytest.param(
            (10, 20, 20, 130), {"ignore_regions": (LOWER,), "region_anchor": "foot"}, False, id="foot-ignored"
        ),
        pytest.param((10, 10, 17, 12), {"min_box_size": 8.0}, False, id="smaller-than-pixels"),
        pytest.param((10, 10, 12, 18), {"min_box_size": 8.0}, True, id="as-large-as-pixels"),
        pytest.param((10, 10, 17, 12), {"min_box_size": 0.02}, False, id="smaller-than-fraction"),
        pytest.param((10, 10, 18, 12), {"min_box_size": 0.02}, True, id="as-large-as-fraction"),
        pytest.param((0, 0, 400, 50), {"max_box_size": 0.9}, False, id="as-wide-as-the-image"),
        pytest.param((0, 0, 101, 10), {"max_box_size": 100.0}, False, id="above-pixels"),
        pytest.param((0, 0, 100, 10), {"max_box_size": 100.0, "min_box_size": 0.25}, True, id="both-sizes"),
    ],
)
def test_a_box_counts_by_its_place_and_size(
    box_xyxy: tuple[float, ...], settings: dict[str, Any], counts: bool
) -> None:
    assert admitted(box_xyxy, **settings) is counts


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        pytest.param({}, None, id="nothing"),
        pytest.param({"regions": ["0,0 1,0 1,1 0,1"]}, BoxFilter(regions=(WHOLE,)), id="regions"),
        pytest.param({"min_box_size": 1.5}, BoxFilter(min_box_size=1.5), id="minimum"),
        pytest.param({"max_box_size": 0.5}, BoxFilter(max_box_size=0.5), id="maximum"),
    ],
)
def test_without_regions_and_sizes_no_box_is_looked_at(
    settings: dict[str, Any], expected: BoxFilter | None
) -> None:
    assert selection_of(validated(settings), ("cat",)).box_filter == expected
