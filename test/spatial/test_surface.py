"""The surface in a box stands before the background, and is more frequent in the box than around it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.box_samples import SIDE
from yolov5_lifecycle.spatial.depth_image import MIN_DEPTH_M, DepthImage
from yolov5_lifecycle.spatial.surface import surfaces_m

NAN = np.nan
Depth = NDArray[np.float64]

BOX = np.array([[30, 30, 50, 50]], np.float32)
"""Each of its samples is one pixel."""
IN_BOX = slice(30, 50), slice(30, 50)


def surface(inside: Depth | list[list[float]], around: float | Depth) -> NDArray[np.float32]:
    """The surface (SIDE, SIDE) of a box that holds the rows `inside`, in a depth image of `around`."""
    depth_m = np.full((80, 80), around, np.float32)
    depth_m[IN_BOX] = np.broadcast_to(inside, (SIDE, SIDE))
    return np.asarray(surfaces_m(DepthImage(depth_m, 1.0), BOX)[0])


def rows(*parts: tuple[int, float]) -> Depth:
    """(SIDE, SIDE) of so many rows of each value."""
    return np.repeat([value for _, value in parts], [count for count, _ in parts])[:, None] * np.ones(SIDE)


def extents(found: NDArray[np.float32]) -> tuple[float, float]:
    seen = found[~np.isnan(found)]
    return (float(seen.min()), float(seen.max())) if seen.size else (NAN, NAN)


@pytest.mark.parametrize(
    ("inside", "around", "expected"),
    [
        pytest.param(rows((20, NAN)), 2.0, (NAN, NAN), id="no measurement"),
        pytest.param(rows((20, 2.0)), NAN, (2.0, 2.0), id="nothing around"),
        pytest.param(rows((20, 2.0)), 2.0, (2.0, 2.0), id="the same around"),
        pytest.param(rows((9, 2.0), (11, NAN)), 2.0, (NAN, NAN), id="the same around, few measured"),
        pytest.param(rows((11, 2.0), (9, NAN)), 2.0, (2.0, 2.0), id="the same around, half measured"),
        pytest.param(rows((1, 1.0), (19, NAN)), 2.0, (1.0, 1.0), id="just enough measured"),
        pytest.param(rows((6, 1.0), (14, 2.0)), NAN, (1.0, 1.0), id="the nearer of two"),
        pytest.param(rows((2, 1.0), (18, 2.0)), NAN, (2.0, 2.0), id="the nearer one is too small"),
        pytest.param(rows((18, MIN_DEPTH_M), (2, NAN)), 2.0, (0.01, 0.01), id="as near as possible"),
        pytest.param(rows((12, 1.0), (8, 2.0)), 1.0, (2.0, 2.0), id="the nearer one goes on around"),
        pytest.param(rows((10, 1.0), (10, 3.0)), 3.0, (1.0, 1.0), id="the farther one goes on around"),
        pytest.param(rows((10, 1.0), (4, 1.1), (6, 3.0)), 3.0, (1.0, 1.1), id="a step"),
        pytest.param(rows((14, 1.2), (1, 1.0), (5, 3.0)), 3.0, (1.2, 1.2), id="a little that is nearer"),
        pytest.param(rows((10, 1.0), (4, 1.3), (6, 3.0)), 3.0, (1.0, 1.3), id="a part farther behind"),
        pytest.param(rows((10, 1.0), (4, 1.8), (6, 3.0)), 3.0, (1.0, 1.0), id="too far behind"),
    ],
)
def test_a_surface_stands_out(inside: Depth, around: float, expected: tuple[float, float]) -> None:
    np.testing.assert_allclose(extents(surface(inside, around)), expected, rtol=1e-6)


def test_a_surface_that_recedes_is_seen_to_its_far_end() -> None:
    receding = np.linspace(1.0, 2.0, SIDE)[:, None] * np.ones(SIDE)
    found = surface(receding, 4.0)
    np.testing.assert_allclose(found, receding, rtol=0.03)


def test_a_surface_is_where_its_samples_are() -> None:
    inside = np.full((SIDE, SIDE), 3.0)
    inside[4:12, 6:9] = 1.0
    np.testing.assert_array_equal(surface(inside, 3.0), np.where(inside == 1.0, 1.0, NAN))


def test_samples_between_a_surface_and_the_background_are_left_out() -> None:
    inside = np.full((SIDE, SIDE), 2.0)
    inside[:, :10] = 1.0
    inside[:, 10] = np.random.default_rng(1).uniform(1.05, 1.95, SIDE)
    assert extents(surface(inside, 2.0)) == (1.0, 1.0)


@pytest.mark.parametrize("every", [2, 3, 4])
def test_sparse_depth_has_a_surface(every: int) -> None:
    """As a lidar's that is projected into the image: pixels next to measurements are not measured."""
    depth_m = np.full((80, 80), 4.0)
    depth_m[IN_BOX] = np.linspace(1.0, 1.3, SIDE)[:, None]
    sparse = np.zeros_like(depth_m, np.float32)
    sparse[::every, ::every] = depth_m[::every, ::every]
    (found,) = surfaces_m(DepthImage(sparse, 1.0), BOX)
    near, far = extents(found)
    assert near < 1.05
    assert 1.2 < far < 1.35


def test_every_box_has_its_own_surface() -> None:
    depth_m = np.full((80, 160), 4.0, np.float32)
    depth_m[30:50, 30:50], depth_m[30:50, 110:130] = 1.0, 2.0
    boxes = np.array([[30, 30, 50, 50], [110, 30, 130, 50]], np.float32)
    near, far = surfaces_m(DepthImage(depth_m, 1.0), boxes)
    assert extents(near) == (1.0, 1.0)
    assert extents(far) == (2.0, 2.0)
