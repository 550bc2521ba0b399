"""Conversions between ROS messages and the project's own types."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import vision_msgs.msg
from geometry_msgs.msg import Transform
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header
from vision_msgs.msg import (
    BoundingBox3D,
    Detection2D,
    Detection2DArray,
    Detection3D,
    Detection3DArray,
    ObjectHypothesisWithPose,
)

from yolov5_lifecycle.detection import messages
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.compressed import compressed_image, is_jpeg
from yolov5_lifecycle.images.encodings import raw_image
from yolov5_lifecycle.images.image import ColourImage, bytes_of
from yolov5_lifecycle.spatial.placement import Box3D, Placement
from yolov5_lifecycle.spatial.points import SurfacePoints

_EXIF_BYTES = 1 << 16
"""EXIF data are at the beginning of a JPEG file."""


def image_of_message(message: Image | CompressedImage) -> ColourImage:
    """Image in `message`, without a copy where the encoding allows; raises ImageError."""
    return compressed_image(message) if isinstance(message, CompressedImage) else raw_image(message)


def jpeg_of_message(message: Image | CompressedImage, image: ColourImage) -> NDArray[np.uint8] | None:
    """The JPEG file (N,) in `message`, without a copy, if every reader sees `image` in it; else None.

    Others are rotated by their EXIF data, which ROS ignores, have red and blue exchanged, or are mosaics.
    """
    if not isinstance(message, CompressedImage) or image.channel_order != "bgr":
        return None
    data = bytes_of(message.data)
    return data if is_jpeg(data) and b"Exif" not in data[:_EXIF_BYTES].tobytes() else None


def image_message(pixels: NDArray[Any], encoding: str, header: Header) -> Image:
    """Image message of pixels (H, W) or (H, W, channels) in `encoding`: 16UC1 for depths and masks."""
    message = Image(header=header, **messages.image_fields(pixels, encoding))
    message.data = _array_of(pixels.astype(pixels.dtype.newbyteorder("<"), copy=False))
    return message


def compressed_image_message(jpeg: NDArray[np.uint8], encoding: str, header: Header) -> CompressedImage:
    """CompressedImage message of JPEG bytes, which image_transport decompresses to `encoding`."""
    # As image_transport formats it: source encoding, codec and colour order, the latter empty for mono8.
    colours = "" if encoding == "mono8" else "bgr8"
    message = CompressedImage(header=header, format=f"{encoding}; jpeg compressed {colours}")
    message.data = _array_of(jpeg)
    return message


def _array_of(values: NDArray[Any]) -> array[int]:
    # Setters iterate over every byte of anything but an array (ros2/rclpy#836): 127 ms for 640x480 pixels.
    buffer = array("B")
    buffer.frombytes(np.ascontiguousarray(values).data.cast("B"))
    return buffer


def detection_array(detections: Detections, class_names: Sequence[str], header: Header) -> Detection2DArray:
    """Detection2DArray message in source pixels, with the header of the source image."""
    return messages.detection_array(detections.objects(class_names), header, vision_msgs.msg)


def detection_3d_array_message(
    detections: Detection2DArray,
    placements: Sequence[Placement],
    frame_id: str,
    transform: Transform | None = None,
) -> Detection3DArray:
    """Detection3DArray message of those `detections` that have a place in space, one placement for each.

    Stamp, order, ids, classes and scores are those of `detections`; `frame_id` is the optical frame of the
    depth image, or where `transform` leads from there. Raises ValueError when there are not as many
    placements as detections.
    """
    header, transform = Header(stamp=detections.header.stamp, frame_id=frame_id), transform or Transform()
    placed = [
        (detection, placement)
        for detection, placement in zip(detections.detections, placements, strict=True)
        if isinstance(placement, Box3D)
    ]
    centres_m = moved(np.array([box.centre_xyz_m for _, box in placed]).reshape(-1, 3), transform).tolist()
    found = []
    for (detection, box), centre_m in zip(placed, centres_m, strict=True):
        bbox = BoundingBox3D()
        bbox.center.position.x, bbox.center.position.y, bbox.center.position.z = centre_m
        bbox.center.orientation = transform.rotation  # the box stays parallel to the axes of the camera
        bbox.size.x, bbox.size.y, bbox.size.z = box.size_xyz_m
        found.append(_detection_3d(detection, bbox, header))
    return Detection3DArray(header=header, detections=found)


def moved(xyz_m: NDArray[np.floating], transform: Transform) -> NDArray[np.float64]:
    """Points (n, 3) in the frame to which `transform` leads."""
    turn, shift = transform.rotation, transform.translation
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    rotation = np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )
    return np.asarray(xyz_m @ rotation.T + (shift.x, shift.y, shift.z), np.float64)


def _detection_3d(detection: Detection2D, bbox: BoundingBox3D, header: Header) -> Detection3D:
    results = [ObjectHypothesisWithPose(hypothesis=result.hypothesis) for result in detection.results]
    for result in results:
        result.pose.pose = bbox.center
    return Detection3D(header=header, results=results, bbox=bbox, id=detection.id)


_POINT = np.dtype(
    [*((name, "<f4") for name in ("x", "y", "z", "rgb", "score")), ("detection", "<u4"), ("class_id", "<u4")]
)
_DATATYPES = {np.dtype("<f4"): PointField.FLOAT32, np.dtype("<u4"): PointField.UINT32}


def point_cloud_message(
    points: Iterable[SurfacePoints], detections: Detections, image: ColourImage, header: Header
) -> PointCloud2:
    """Cloud of the points on the surfaces of `detections`, each with its colour in their `image`.

    `rgb` has the three bytes of a colour in the bits of a float, as PCL and RViz expect it.
    """
    pixels, width = image.pixels.reshape(-1, 3), image.size_hw[1]
    records = []
    for of_object in points:
        colours = pixels.take(of_object.rows * width + of_object.columns, axis=0)
        bgr = colours if image.channel_order == "bgr" else colours[:, ::-1]
        records.append(_point_records(of_object, bgr, detections))
    message = PointCloud2(
        header=header,
        height=1,
        width=sum(map(len, records)),
        fields=[
            PointField(name=name, offset=offset, datatype=_DATATYPES[dtype], count=1)
            for name, (dtype, offset, *_) in (_POINT.fields or {}).items()
        ],
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=sum(each.nbytes for each in records),
        is_dense=True,
    )
    message.data = array("B", b"".join(each.view(np.uint8).data for each in records))
    return message


def _point_records(points: SurfacePoints, bgr: NDArray[np.uint8], detections: Detections) -> NDArray[Any]:
    records = np.empty(len(points.rows), _POINT)
    records["x"], records["y"], records["z"] = points.xyz_m.T
    blue, green, red = bgr.T.astype(np.uint32)
    records["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    records["detection"] = points.box
    records["class_id"] = detections.class_ids[points.box]
    records["score"] = detections.scores[points.box]
    return records


def moved_cloud(cloud: PointCloud2, transform: Transform | None) -> PointCloud2:
    """The same message, its points moved to the frame to which `transform` leads; None: they are there."""
    if transform is not None:
        xyz_m = points_of_cloud(cloud).view("<f4").reshape(cloud.width, -1)[:, :3]
        for part in np.array_split(xyz_m, len(xyz_m) // 10_000 + 1):  # each small enough for the cache
            part[:] = moved(part, transform)
    return cloud


def points_of_cloud(cloud: PointCloud2) -> NDArray[Any]:
    """A record (n,) for each point in a message of `point_cloud_message`: a view of its data."""
    return np.frombuffer(cloud.data, _POINT)


def stamp_ns(header: Header) -> int:
    """Stamp in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def stamp_s(header: Header) -> float:
    """Stamp in seconds, exact to less than a microsecond."""
    return float(header.stamp.sec) + float(header.stamp.nanosec) * 1e-9
