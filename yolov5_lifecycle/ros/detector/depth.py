"""Depth of a camera: its subscriptions, where detections are in space, and why they have no place there."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.detector.camera_topic import DISCOVERY_S, depth_topics
from yolov5_lifecycle.ros.detector.image_input import Subscription
from yolov5_lifecycle.ros.messages import stamp_ns
from yolov5_lifecycle.ros.topics import DEPTH_CAMERA_INFO, DEPTH_IMAGE_RAW, full_name, of_camera
from yolov5_lifecycle.settings.camera_overrides import setting_of
from yolov5_lifecycle.spatial.camera_model import Intrinsics, intrinsics_of_message
from yolov5_lifecycle.spatial.depth_image import DepthImage, depth_image_of_message
from yolov5_lifecycle.spatial.placement import Box3D, Placement, Unplaced, place, unusable
from yolov5_lifecycle.spatial.stamp_pairing import DepthPairing, Unpaired
from yolov5_lifecycle.spatial.surface import ObjectMasks, Surfaces, surfaces_in


@dataclass(frozen=True)
class PlacedImage:
    """Places of the detections in one image, and with what they were found."""

    placements: tuple[Placement, ...]
    frame_id: str
    """Coordinate frame of the depth image."""
    surfaces: Surfaces
    depth: DepthImage
    camera: Intrinsics

    @property
    def distances_m(self) -> list[float | None]:
        """Distance of each detection from the camera, None where it is unknown."""
        return [placed.distance_m if isinstance(placed, Box3D) else None for placed in self.placements]


@dataclass(frozen=True)
class RunWithoutDepth:
    """Consecutive images up to now whose detections could not be placed, with the reason for the last one."""

    reason: str
    begun_s: float
    ended_s: float


RECENT_S = 2.0
"""A rejection or failure is reported in diagnostics for this long."""
UNPLACED_S = 2.0
"""Images without depth for longer than this are reported."""
_LOG_PERIOD_S = 5.0
_NO_PLACE = "detections have no place in space"
_REGISTER = (
    "subscribe to depth images that are registered to the colour camera, which its driver publishes as "
    "aligned depth, or else `ros2 run depth_image_proc register_node` for rectified images"
)
_OTHER_INFO = (
    "send the camera_info of the depth images: one with binning or a region of interest is that of the whole "
    "sensor"
)
_BLANK = (
    "nothing is measured anywhere in the depth images: is the sensor on, uncovered and within its range? "
    "16UC1 is in millimetres, 32FC1 in metres"
)


_QUEUE = 2
_RECEIVED, _PLACED = "depth images received", "detections placed"
_IMAGES_REJECTED, _INFOS_REJECTED = "depth images rejected", "camera_infos rejected"
_WITH_DEPTH, _WITHOUT_DEPTH = "images with depth", "images without depth"
_UNPLACED = {reason: f"unplaced: {reason.value}" for reason in Unplaced}
_COUNTED = _RECEIVED, _IMAGES_REJECTED, _INFOS_REJECTED, _WITH_DEPTH, _WITHOUT_DEPTH, _PLACED


@dataclass(eq=False)
class DepthInput:
    """Owns the subscriptions to depth images and camera_info while depth is needed, and places detections in
    space with the newest ones.

    `camera`: see `of_camera`. `slop_s` is the setting `depth_slop_s`. An unusable message is rejected with a
    throttled warning, and the previous ones are kept.

    `expect` and `place` are called in the inference thread, the rest in the executor. `clock` returns
    monotonic seconds.
    """

    node: Node
    _: KW_ONLY
    camera: str = ""
    slop_s: float
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._subscriptions: list[Subscription] = []
        """To depth images and to camera_info; empty while depth is not needed."""
        self._pairing: DepthPairing[tuple[DepthImage, str]] = DepthPairing(self.slop_s)
        """Depth images, each with the name of its coordinate frame."""
        self._intrinsics: Intrinsics | None = None
        self.counts = dict.fromkeys((*_COUNTED, *_UNPLACED.values()), 0)
        """By their names in diagnostics; each number is written by one thread only."""
        self.run: RunWithoutDepth | None = None
        self.rejection, self.rejected_s = "", float("-inf")
        """Why the last depth image or camera_info was rejected, and when."""
        self._logged_s = float("-inf")
        self._info_problem = ""
        """Why the last camera_info was rejected; "" if it was not."""

    def follow(self, *, is_needed: bool) -> None:
        """Subscribe if depth is needed, else unsubscribe and forget what was received."""
        if is_needed and not self._subscriptions:
            image, camera_info = depth_topics(self.node, self.camera)
            self._subscriptions = [
                Subscription(image, self.take_image, depth=_QUEUE),
                Subscription(camera_info, self.take_camera_info, depth=_QUEUE, takes_latched=True),
            ]
            self.update()
        elif not is_needed and self._subscriptions:
            for subscription in self._subscriptions:
                subscription.close()
            self._subscriptions = []
            self._pairing.clear()
            self._intrinsics, self._info_problem, self.run = None, "", None

    def update(self) -> None:
        """Subscribe again if what the publishers offer requires it."""
        for subscription in self._subscriptions:
            subscription.follow()

    @property
    def hint(self) -> str:
        """Why nothing is published on ~/detections_3d; "" if there is no reason, or while nobody needs it."""
        for subscription, what in zip(self._subscriptions, ("depth images", "its camera_info"), strict=False):
            source = subscription.topic.look()
            if source.publishers == 0 and source.missing_s > DISCOVERY_S:
                setting = setting_of("depth", self.camera)
                where, remedy = "", f"start the depth camera, remap the topic or set {setting} to false"
                if source.sent_as:
                    where, remedy = f" (but in another form on {source.sent_as})", source.remedy
                return f"no publisher of {what} on {source.name}{where}: {_NO_PLACE}; {remedy}"
        if not self._subscriptions:
            return ""
        if self.clock() - self.rejected_s < RECENT_S:
            return f"{_NO_PLACE}: {self.rejection}"
        run = self.run
        if run is not None and run.ended_s - run.begun_s > UNPLACED_S:
            return f"{_NO_PLACE}: {run.reason}"
        return ""

    def values(self) -> dict[str, str]:
        """All values as strings, for diagnostics."""
        values = {}
        if self._subscriptions:
            image, camera_info = (each.topic.look() for each in self._subscriptions)
            values["depth topic"] = image.name
            values["depth publishers"] = str(image.publishers)
            values["camera_info publishers"] = str(camera_info.publishers)
        if (camera := self._intrinsics) is not None:
            values["depth lens"] = camera.distortion.model if camera.distortion else "rectified"
        return values | {name: str(count) for name, count in self.counts.items()}

    def take_image(self, message: Image) -> None:
        """Keep a depth image, without a copy; reject one that cannot be read."""
        self.counts[_RECEIVED] += 1
        try:
            depth = depth_image_of_message(message), message.header.frame_id
        except ImageError as error:
            self._reject(_IMAGES_REJECTED, f"depth images are rejected: {error}")
            return
        self._pairing.add(stamp_ns(message.header), depth)

    def take_camera_info(self, message: CameraInfo) -> None:
        """Use these intrinsics from now on; reject those of an uncalibrated camera."""
        try:
            self._intrinsics = intrinsics_of_message(message, is_rectified=self._is_rectified())
            self._info_problem = ""
        except ImageError as error:
            self._info_problem = f"camera_info is rejected: {error}"
            self._reject(_INFOS_REJECTED, self._info_problem)

    def expect(self, header: Header) -> None:
        """Keep the depth image nearest in time to the image with this header until the next call."""
        self._pairing.expect(stamp_ns(header))

    def place(
        self,
        boxes_xyxy: NDArray[np.float32],
        image_size_hw: tuple[int, int],
        header: Header,
        masks: ObjectMasks | None = None,
    ) -> PlacedImage | None:
        """Place the boxes (n, 4) of the image with this header, whose objects have these masks if they are
        known, with the depth image nearest in time.

        None, counted with the reason, if no depth image fits.
        """
        count, intrinsics = len(boxes_xyxy), self._intrinsics
        paired = self._pairing.pair(stamp_ns(header))
        if isinstance(paired, Unpaired):
            missing = Unplaced.NO_DEPTH_IMAGE
            self._count_unplaced(count, missing, f"{missing.value}: {paired.value}")
            return None
        depth, frame_id = paired
        if (unfit := unusable(image_size_hw, depth, intrinsics)) is not None:
            found = _of_another_size(image_size_hw, depth, intrinsics) if intrinsics else self._without_info()
            self._count_unplaced(count, unfit, f"{unfit.value}: {found}")
            return None
        frames = {frame_id.lstrip("/"), header.frame_id.lstrip("/")} - {""}  # tf's names began with / once
        if len(frames) > 1:
            self._count_unplaced(count, Unplaced.OTHER_CAMERA, _of_another_camera(header.frame_id, frame_id))
            return None
        assert intrinsics is not None
        surfaces = surfaces_in(boxes_xyxy, depth, intrinsics, masks)
        placements = place(surfaces, intrinsics)
        for placement in placements:
            name = _UNPLACED[placement] if isinstance(placement, Unplaced) else _PLACED
            self.counts[name] += 1
        self.counts[_WITH_DEPTH] += 1
        if Unplaced.NO_VALID_DEPTH in placements and depth.is_blank:
            self._go_on(_BLANK)
        else:
            self.run = None
        return PlacedImage(placements, frame_id or header.frame_id, surfaces, depth, intrinsics)

    def _is_rectified(self) -> bool:
        """By the name of the depth images, as image_proc and drivers give it: image_rect, image_rect_raw."""
        name = full_name(self.node, of_camera(DEPTH_IMAGE_RAW, self.camera))
        return re.search("(^|_)rect", name.rpartition("/")[2]) is not None

    def _without_info(self) -> str:
        topic = full_name(self.node, of_camera(DEPTH_CAMERA_INFO, self.camera))
        remedy = "it must be published again and again, or once as transient local"
        return self._info_problem or f"none has arrived on {topic}; {remedy}"

    def _reject(self, count: str, why: str) -> None:
        self.counts[count] += 1
        self.rejection, self.rejected_s = why, self.clock()
        if self.rejected_s - self._logged_s >= _LOG_PERIOD_S:  # rclpy would throttle all cameras together
            self._logged_s = self.rejected_s
            self.node.get_logger().warning(f"{self.camera}: {why}" if self.camera else why)

    def _count_unplaced(self, count: int, reason: Unplaced, told: str) -> None:
        """None of the `count` detections in an image can be placed; `told` is the `reason` in detail."""
        self._go_on(told)
        self.counts[_WITHOUT_DEPTH] += 1
        self.counts[_UNPLACED[reason]] += count

    def _go_on(self, told: str) -> None:
        """Nothing in this image has a place, either; `told` is the reason."""
        now_s, run = self.clock(), self.run  # `follow` may clear it in the executor
        self.run = RunWithoutDepth(told, run.begun_s if run else now_s, now_s)


def _of_another_size(image_size_hw: tuple[int, int], depth: DepthImage, intrinsics: Intrinsics) -> str:
    sizes = (image_size_hw, depth.size_hw, intrinsics.size_hw)
    colour, of_depth, of_info = (f"{width}x{height}" for height, width in sizes)
    found = f"images of {colour}, depth images of {of_depth}, camera_info of {of_info} pixels"
    return f"{found}; {_OTHER_INFO if colour == of_depth else _REGISTER}"


def _of_another_camera(colour_frame: str, depth_frame: str) -> str:
    found = f"images of the frame {in_one_line(colour_frame)}, depth images of {in_one_line(depth_frame)}"
    same = "if they are of one camera, give both one frame_id"
    return f"{Unplaced.OTHER_CAMERA.value}: {found}; {_REGISTER}; {same}"
