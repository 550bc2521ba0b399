"""A camera_info becomes the ray of each pixel, through the lens where nobody has rectified the images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.depth_scene import pixels

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.spatial.camera_model import Distortion, Intrinsics, intrinsics_of_message

SIZE_HW = (480, 640)
K = [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
P = [400.0, 0.0, 310.0, -20.0, 0.0, 410.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0]


def message(
    k: list[float],
    p: list[float],
    size_hw: tuple[int, int] = SIZE_HW,
    model: str = "plumb_bob",
    d: Sequence[float] = (),
) -> Any:
    """A sensor_msgs/CameraInfo."""
    height, width = size_hw
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="depth"),
        k=k,
        p=p,
        height=height,
        width=width,
        distortion_model=model,
        d=d,
    )


NO_P = [0.0] * 12
OF_P, OF_K = Intrinsics(400.0, 410.0, 310.0, 230.0, SIZE_HW), Intrinsics(500.0, 510.0, 320.0, 240.0, SIZE_HW)
BARREL = (-0.35, 0.12, 0.001, -0.002, 0.0)
IDEAL_FISHEYE = replace(OF_K, distortion=Distortion("equidistant", (0.0,) * 4))
LENSES = {
    "none": OF_K,
    "barrel": replace(OF_K, fx=400.0, fy=400.0, distortion=Distortion("plumb_bob", BARREL)),
    "pincushion of four numbers": replace(OF_K, distortion=Distortion("plumb_bob", (0.15, -0.1, 0.0, 0.001))),
    "rational": replace(
        OF_K, distortion=Distortion("rational_polynomial", (0.5, -2.7, 6e-4, -2e-4, 1.6, 0.38, -2.5, 1.5))
    ),
    "fisheye of 150 degrees": replace(
        OF_K, fx=270.0, fy=275.0, distortion=Distortion("equidistant", (0.05, -0.01, 0.003, -0.001))
    ),
}


@pytest.mark.parametrize(
    ("p", "model", "d", "is_rectified", "expected"),
    [
        pytest.param(P, "plumb_bob", BARREL, True, OF_P, id="rectified"),
        pytest.param(NO_P, "", (), True, OF_K, id="rectified, without P"),
        pytest.param(P, "plumb_bob", (0.0,) * 5, False, OF_K, id="no distortion"),
        pytest.param(NO_P, "", (), False, OF_K, id="nothing but K"),
        pytest.param(
            P,
            "plumb_bob",
            BARREL,
            False,
            replace(OF_K, distortion=Distortion("plumb_bob", BARREL)),
            id="lens",
        ),
        pytest.param(P, "equidistant", (0.0,) * 4, False, IDEAL_FISHEYE, id="ideal fisheye"),
        pytest.param(P, "unknown", BARREL, True, OF_P, id="rectified, of any lens"),
    ],
)
def test_p_counts_of_rectified_images_and_k_and_d_of_all_others(
    p: list[float], model: str, d: Sequence[float], is_rectified: bool, expected: Intrinsics
) -> None:
    assert intrinsics_of_message(message(K, p, model=model, d=d), is_rectified=is_rectified) == expected


@pytest.mark.parametrize(
    ("model", "d", "reason"),
    [
        pytest.param("unknown", BARREL, "rational_polynomial, equidistant, found 'unknown'", id="model"),
        pytest.param(
            "plumb_bob", BARREL[:3], r"4 or 5 numbers D of plumb_bob, found 3: \(-0.3", id="too few"
        ),
        pytest.param("equidistant", BARREL, "4 numbers D of equidistant", id="too many"),
        pytest.param("plumb_bob", (math.nan, *BARREL[1:]), "numbers D of plumb_bob, found 5: .nan", id="NaN"),
        pytest.param("plumb_bob", (1e300, *BARREL[1:]), "25% of the image, found one for 0%", id="huge"),
        pytest.param("equidistant", (1e300, 1.0, 1.0, 1.0), "25% of the image, found", id="huge, fisheye"),
    ],
)
def test_a_lens_that_is_unknown_or_sees_nothing_is_refused_with_the_remedy(
    model: str, d: Sequence[float], reason: str
) -> None:
    with pytest.raises(ImageError, match=rf"{reason}.*alibrate the camera again"):
        intrinsics_of_message(message(K, P, model=model, d=d), is_rectified=False)


@pytest.mark.parametrize("lens", LENSES)
def test_a_ray_meets_the_image_where_it_came_from(lens: str) -> None:
    columns, rows = np.random.default_rng(3).uniform(0, 1, (2, 500)) * [[640], [480]]
    tangents = np.array(LENSES[lens].tangents(columns, rows))
    assert np.isfinite(tangents).all()
    seen = pixels(LENSES[lens], tangents) + 0.5
    np.testing.assert_allclose(seen, (columns, rows), atol=0.3 if "fisheye" in lens else 0.1)


@pytest.mark.parametrize(
    ("camera", "widest"),
    [
        pytest.param(
            replace(OF_K, fx=300.0, fy=300.0, distortion=Distortion("plumb_bob", (-0.4, 0.11, 0, 0, -0.01))),
            2.24,
            id="the model folds over",
        ),
        pytest.param(
            replace(OF_K, fx=300.0, fy=300.0, distortion=Distortion("plumb_bob", (-0.3, 0, 0, 0))),
            1.06,
            id="the model folds over, and turns the image round",
        ),
        pytest.param(replace(IDEAL_FISHEYE, fx=150.0, fy=150.0), 29.0, id="behind the camera"),
    ],
)
def test_what_a_lens_cannot_see_has_no_ray(camera: Intrinsics, widest: float) -> None:
    columns, rows = np.meshgrid(np.linspace(0, 640, 41), np.linspace(0, 480, 31))
    tangents = np.array(camera.tangents(columns, rows))
    is_seen = np.asarray(np.isfinite(tangents).all(axis=0))
    assert 0.3 < is_seen.mean() < 0.8
    assert is_seen[15, 20]
    assert np.hypot(*tangents[:, is_seen]).max() < widest
    seen = pixels(camera, tangents[:, is_seen]) + 0.5
    np.testing.assert_allclose(seen, (columns[is_seen], rows[is_seen]), atol=3)


@pytest.mark.parametrize(
    ("k", "p"),
    [
        pytest.param([0.0] * 9, [0.0] * 12, id="not calibrated"),
        pytest.param(K, [math.nan, *P[1:]], id="NaN"),
        pytest.param([*K[:4], 1e300, *K[5:]], [0.0] * 12, id="huge focal length"),
        pytest.param([1e-300, *K[1:]], [0.0] * 12, id="tiny focal length"),
        pytest.param([-1.0, *K[1:]], [0.0] * 12, id="negative focal length"),
        pytest.param([*K[:2], -1e300, *K[3:]], [0.0] * 12, id="principal point far away"),
    ],
)
def test_values_of_no_camera_are_refused(k: list[float], p: list[float]) -> None:
    with pytest.raises(ImageError, match=r"fx and fy of 0.1 to 1e\+07 pixels .* found fx .* Calibrate"):
        intrinsics_of_message(message(k, p), is_rectified=True)


@pytest.mark.parametrize(("k", "p"), [([], P), (K, []), (K[:8], P)], ids=["no K", "no P", "short K"])
def test_matrices_of_another_size_are_refused(k: list[float], p: list[float]) -> None:
    with pytest.raises(ImageError, match="K of 9 and P of 12 values, found"):
        intrinsics_of_message(message(k, p), is_rectified=True)


@pytest.mark.parametrize("size_hw", [(0, 640), (480, 0), (480, 16385)])
def test_a_size_of_no_image_is_refused(size_hw: tuple[int, int]) -> None:
    with pytest.raises(ImageError, match="1 to 16384 pixels"):
        intrinsics_of_message(message(K, P, size_hw), is_rectified=True)
