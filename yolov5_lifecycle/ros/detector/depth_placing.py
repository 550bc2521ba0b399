"""Placing of detections in space with depth images and camera_info; failures are counted by reason."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.spatial.depth_image import DepthImage, depth_image_of_message
from yolov5_lifecycle.spatial.intrinsics import Intrinsics, IntrinsicsError, intrinsics_of_message
from yolov5_lifecycle.spatial.placement import Box3D, Placement, Unplaced, place, unusable
from yolov5_lifecycle.spatial.stamp_pairing import DepthPairing, Unpaired


@dataclass(frozen=True, eq=False)
class FramedDepth:
    """A depth image and the name of its coordinate frame."""

    image: DepthImage
    frame_id: str


@dataclass(frozen=True)
class PlacedImage:
    """Places of the detections in one image, and their coordinate frame."""

    placements: tuple[Placement, ...]
    frame_id: str

    @property
    def distances_m(self) -> list[float | None]:
        """Distance of each detection from the camera, None where it is unknown."""
        return [placed.distance_m if isinstance(placed, Box3D) else None for placed in self.placements]


@dataclass
class PlacingCounts:
    """What has been received and placed so far. Each number is written by one thread only."""

    depth_images: int = 0
    rejected_depth_images: int = 0
    rejected_camera_infos: int = 0
    placed_images: int = 0
    """Images with a matching depth image and camera_info."""
    unplaced_images: int = 0
    placed: int = 0
    unplaced: Counter[Unplaced] = field(default_factory=Counter)


@dataclass(frozen=True)
class UnplacedRun:
    """Consecutive images up to now whose detections could not be placed, with the reason for the last one."""

    reason: str
    begun_s: float
    ended_s: float


class DepthPlacing:
    """Keeps the newest depth images and the camera_info, and places detections with them.

    `take_image` and `take_camera_info` are called in the executor, `expect` and `place` in the inference
    thread; any thread may read the rest. An unusable message is rejected with a throttled warning, and the
    previous ones are kept. `clock` returns monotonic seconds.
    """

    def __init__(self, node: Node, *, slop_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._node = node
        self._clock = clock
        self._pairing: DepthPairing[FramedDepth] = DepthPairing(slop_s)
        self._intrinsics: Intrinsics | None = None
        self.counts = PlacingCounts()
        self.run: UnplacedRun | None = None
        self.rejection = ""
        self.rejected_s = float("-inf")

    def take_image(self, message: Image) -> None:
        """Keep a depth image, without a copy; reject one that cannot be read."""
        self.counts.depth_images += 1
        try:
            depth = FramedDepth(depth_image_of_message(message), message.header.frame_id)
        except ImageError as error:
            self.counts.rejected_depth_images += 1
            self._reject(f"depth images are rejected: {error}")
            self._node.get_logger().warning(f"depth image rejected: {error}", throttle_duration_sec=5.0)
            return
        self._pairing.add(_nanoseconds(message.header.stamp), depth)

    def take_camera_info(self, message: CameraInfo) -> None:
        """Use these intrinsics from now on; reject those of an uncalibrated camera."""
        try:
            self._intrinsics = intrinsics_of_message(message)
        except IntrinsicsError as error:
            self.counts.rejected_camera_infos += 1
            self._reject(f"camera_info is rejected: {error}")
            self._node.get_logger().warning(f"camera_info rejected: {error}", throttle_duration_sec=5.0)

    def expect(self, stamp: Time) -> None:
        """Keep the depth image nearest to the stamp of the image in progress until the next call."""
        self._pairing.expect(_nanoseconds(stamp))

    def place(
        self, boxes_xyxy: NDArray[np.float32], image_size_hw: tuple[int, int], stamp: Time
    ) -> PlacedImage | None:
        """Place the boxes (n, 4) of the image with this stamp with the depth image nearest to it.

        None, counted with the reason, if no depth image fits.
        """
        count, intrinsics = len(boxes_xyxy), self._intrinsics
        paired = self._pairing.pair(_nanoseconds(stamp))
        if isinstance(paired, Unpaired):
            missing = Unplaced.NO_DEPTH_IMAGE
            self._count_unplaced(count, missing, f"{missing.value}: {paired.value}")
            return None
        depth = paired.item.image
        if (unfit := unusable(image_size_hw, depth, intrinsics)) is not None:
            self._count_unplaced(count, unfit, _explained(unfit, image_size_hw, depth, intrinsics))
            return None
        placements = place(boxes_xyxy, image_size_hw, depth, intrinsics)
        no_place = Counter(placement for placement in placements if isinstance(placement, Unplaced))
        self.counts.placed_images += 1
        self.counts.placed += count - no_place.total()
        self.counts.unplaced.update(no_place)
        self.run = None
        return PlacedImage(placements, paired.item.frame_id)

    def forget(self) -> None:
        """Drop depth images and camera_info, for example after unsubscribing."""
        self._pairing.clear()
        self._intrinsics = None
        self.run = None

    def _count_unplaced(self, count: int, reason: Unplaced, told: str) -> None:
        """None of the `count` detections in an image can be placed; `told` is the `reason` in detail."""
        now_s, run = self._clock(), self.run  # `forget` may clear it in the executor
        self.run = UnplacedRun(told, run.begun_s if run else now_s, now_s)
        self.counts.unplaced_images += 1
        self.counts.unplaced[reason] += count

    def _reject(self, reason: str) -> None:
        self.rejection, self.rejected_s = reason, self._clock()


def _explained(
    reason: Unplaced, image_size_hw: tuple[int, int], depth: DepthImage, intrinsics: Intrinsics | None
) -> str:
    if intrinsics is None:
        return reason.value
    sizes = (image_size_hw, depth.size_hw, intrinsics.size_hw)
    colour, of_depth, of_info = (f"{width}x{height}" for height, width in sizes)
    return f"{reason.value}: images of {colour}, depth images of {of_depth}, camera_info of {of_info} pixels"


def _nanoseconds(stamp: Time) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
