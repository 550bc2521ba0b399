"""The matrices of a CameraInfo become intrinsics, or are refused with the reason."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from yolov5_lifecycle.spatial.intrinsics import (
    Intrinsics,
    IntrinsicsError,
    intrinsics_of,
    intrinsics_of_message,
)

SIZE_HW = (480, 640)
K = [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
P = [400.0, 0.0, 310.0, -20.0, 0.0, 410.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0]


def test_p_counts_where_it_is_filled_in() -> None:
    assert intrinsics_of(K, P, SIZE_HW) == Intrinsics(400.0, 410.0, 310.0, 230.0, SIZE_HW)


def test_k_counts_where_p_is_empty() -> None:
    assert intrinsics_of(K, [0.0] * 12, SIZE_HW) == Intrinsics(500.0, 510.0, 320.0, 240.0, SIZE_HW)


def test_a_message_gives_matrices_and_size() -> None:
    message = SimpleNamespace(header=SimpleNamespace(frame_id="depth"), k=K, p=P, height=480, width=640)
    assert intrinsics_of_message(message) == intrinsics_of(K, P, SIZE_HW)


@pytest.mark.parametrize(
    ("k", "p"),
    [
        pytest.param([0.0] * 9, [0.0] * 12, id="not calibrated"),
        pytest.param([-500.0, *K[1:]], [0.0] * 12, id="negative"),
        pytest.param(K, [math.nan, *P[1:]], id="NaN"),
        pytest.param(K, [*P[:6], math.inf, *P[7:]], id="infinite"),
        pytest.param([1e-300, *K[1:]], [0.0] * 12, id="tiny focal length"),
        pytest.param([*K[:4], 1e300, *K[5:]], [0.0] * 12, id="huge focal length"),
        pytest.param([*K[:2], -1e300, *K[3:]], [0.0] * 12, id="principal point far away"),
    ],
)
def test_values_of_no_camera_are_refused(k: list[float], p: list[float]) -> None:
    with pytest.raises(IntrinsicsError, match=r"fx and fy of 0.1 to 1e\+07 pixels .* found fx .* Calibrate"):
        intrinsics_of(k, p, SIZE_HW)


@pytest.mark.parametrize(("k", "p"), [([], P), (K, []), (K[:8], P)], ids=["no K", "no P", "short K"])
def test_matrices_of_another_size_are_refused(k: list[float], p: list[float]) -> None:
    with pytest.raises(IntrinsicsError, match="K of 9 and P of 12 values, found"):
        intrinsics_of(k, p, SIZE_HW)


@pytest.mark.parametrize("size_hw", [(0, 640), (480, 0), (480, 16385)])
def test_a_size_of_no_image_is_refused(size_hw: tuple[int, int]) -> None:
    with pytest.raises(IntrinsicsError, match="1 to 16384 pixels"):
        intrinsics_of(K, P, size_hw)
