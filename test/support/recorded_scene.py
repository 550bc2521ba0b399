"""The synthetic scene as recordings, images and videos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from yolov5_lifecycle.offline.recording import TYPES
from yolov5_lifecycle.sources.scene import Scene, Truth

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
TOPIC = "/camera/image_raw"
SIZE_HW = (240, 320)
COUNT = 3

_SCENE = Scene(8, SIZE_HW)


def shown(number: int) -> tuple[NDArray[np.uint8], Truth]:
    """RGB pixels of an image and what they show."""
    return _SCENE.frame(number)


def recorded_ns(number: int) -> int:
    """When the image was recorded: later than it was taken, see `stamp_s`."""
    return 1_700_000_000_500_000_007 + number * 40_000_000


def stamp_s(number: int) -> int:
    return 1_700_000_000 + number


def raw(number: int, *, encoding: str = "rgb8", height: int = SIZE_HW[0]) -> Any:
    """The upper `height` rows of the scene."""
    width = SIZE_HW[1]
    return _new(
        IMAGE,
        header=_header(number),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=3 * width,
        data=shown(number)[0][:height].reshape(-1),
    )


def jpeg(number: int) -> Any:
    _, data = cv2.imencode(".jpg", shown(number)[0][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    return _new(COMPRESSED, header=_header(number), format="jpeg", data=np.asarray(data).reshape(-1))


def text() -> Any:
    return _new("std_msgs/msg/String", data="nothing to see")


def record(
    path: Path,
    messages: Sequence[Any] | None = None,
    *,
    storage: StoragePlugin = StoragePlugin.MCAP,
    topics: Sequence[str] = (TOPIC,),
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A new recording at `path` with `messages`, or bytes in place of an Image, on each of `topics`.

    Its messages are the scene unless others are given.
    """
    messages = [raw(number) for number in range(COUNT)] if messages is None else messages
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression is not CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        for topic in topics:
            type_name = next((one.__msgtype__ for one in messages if not isinstance(one, bytes)), IMAGE)
            connection = writer.add_connection(topic, type_name, typestore=TYPES)
            for number, message in enumerate(messages):
                is_raw = isinstance(message, bytes)
                data = message if is_raw else TYPES.serialize_cdr(message, type_name)
                writer.write(connection, recorded_ns(number), data)
    return path


def images(folder: Path) -> Path:
    """The scene as .png files in the new `folder`."""
    folder.mkdir()
    for number in range(COUNT):
        assert cv2.imwrite(str(folder / f"{number}.png"), shown(number)[0][..., ::-1])
    return folder


def video(path: Path) -> Path:
    """The scene as a video of 12.5 frames per second."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 12.5, SIZE_HW[::-1])
    for number in range(COUNT):
        writer.write(np.ascontiguousarray(shown(number)[0][..., ::-1]))
    writer.release()
    return path


def _header(number: int) -> Any:
    stamp = _new("builtin_interfaces/msg/Time", sec=stamp_s(number), nanosec=9)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id="camera")


def _new(type_name: str, **fields: Any) -> Any:
    return TYPES.types[type_name](**fields)
