"""Messages of a depth camera that is aligned to the colour camera."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from support.depth_scene import CAMERA

DEPTH_FRAME = "depth_optical_frame"


def header(stamp_s: float) -> Header:
    """As the depth camera sends it."""
    sec, nanosec = divmod(round(stamp_s * 1e9), 1_000_000_000)
    return Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=DEPTH_FRAME)


def depth_message(depth_m: NDArray[np.float32], stamp_s: float, *, encoding: str = "16UC1") -> Image:
    """A depth image (H, W) in metres, in millimetres if the encoding is 16UC1."""
    sent = np.rint(depth_m * 1000).astype("<u2") if encoding == "16UC1" else depth_m.astype("<f4")
    height, width = depth_m.shape
    message = Image(header=header(stamp_s), height=height, width=width, encoding=encoding)
    message.step = width * sent.itemsize
    message.data = array("B", sent.tobytes())
    return message


def camera_info_message(stamp_s: float, **changes: Any) -> CameraInfo:
    """The intrinsics of the rendered scenes; `changes` replace fields."""
    height, width = CAMERA.size_hw
    k = [CAMERA.fx, 0.0, CAMERA.cx, 0.0, CAMERA.fy, CAMERA.cy, 0.0, 0.0, 1.0]
    message = CameraInfo(header=header(stamp_s), height=height, width=width, k=k)
    for name, value in changes.items():
        setattr(message, name, value)
    return message
