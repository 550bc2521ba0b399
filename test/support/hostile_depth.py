"""Depth images and camera_info that cannot be used."""

from __future__ import annotations

from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo, Image

from support.depth_messages import camera_info_message, depth_message, header

_PIXELS = np.ones((24, 32), np.float32)


def hostile_depths() -> dict[str, Image]:
    """Depth images by a part of the reason for which they are rejected."""
    return {
        "found encoding 'rgb8'": _depth(encoding="rgb8"),
        "found encoding '16UC1; compressedDepth'": _depth(encoding="16UC1; compressedDepth"),
        "need a step >= 64, found 0": _depth(step=0),
        "need 98784247849 bytes": _depth(step=2**32 - 1),
        "found 0": _depth(height=0),
        "found 4294967295": _depth(height=2**32 - 1, width=2**32 - 1),
        "found 1535": _depth(data=depth_message(_PIXELS, 1.0).data[:-1]),
        "frame_id of at most 256 characters, found 100000": _depth(header=_framed("x" * 100_000)),
    }


def hostile_camera_infos() -> dict[str, CameraInfo]:
    """camera_info by a part of the reason for which it is rejected."""
    return {
        "found fx 0": camera_info_message(1.0, k=[0.0] * 9),
        "found fx nan": camera_info_message(1.0, k=[float("nan")] * 9),
        "found fx inf": camera_info_message(1.0, k=[float("inf")] * 9),
        "found fx 1e-300": camera_info_message(1.0, k=[1e-300] * 9),
        "found fx -1": camera_info_message(1.0, k=[-1.0] * 9),
        "frame_id of at most 256 characters, found 100000": camera_info_message(
            1.0, header=_framed("x" * 100_000)
        ),
        "found 240 x 0": camera_info_message(1.0, width=0),
        "found 240 x 4294967295": camera_info_message(1.0, width=2**32 - 1),
    }


def _depth(**changes: Any) -> Image:
    message = depth_message(_PIXELS, 1.0)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def _framed(frame_id: str) -> Any:
    changed = header(1.0)
    changed.frame_id = frame_id
    return changed
