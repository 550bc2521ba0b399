"""Path of one frame: image message in, result messages out; publishers exist from configure to cleanup."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import Transform
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray, Detection3DArray, LabelInfo

from yolov5_lifecycle.collecting.candidate import Origin
from yolov5_lifecycle.collecting.collector import CameraCollecting
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.nms import Selection, narrowed
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.detector.depth import DepthInput, PlacedImage
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.transforms import FrameOutput
from yolov5_lifecycle.ros.topics import (
    COMPRESSED_IMAGE,
    DETECTIONS,
    DETECTIONS_3D,
    IMAGE,
    LABEL_INFO,
    MASKS,
    POINTS,
    endpoint_name,
    of_camera,
    overriding_options,
)
from yolov5_lifecycle.spatial.points import SurfacePoints, surface_points
from yolov5_lifecycle.streaming.frame_statistics import EmptyFrames, LatencyWindow
from yolov5_lifecycle.streaming.inference_threads import Send
from yolov5_lifecycle.tracking.byte_tracker import TrackedDetection


@dataclass(frozen=True)
class DetectedFrame:
    """A frame with its image and the detections in it, found with `Pipeline.wanted`."""

    frame: ReceivedFrame
    image: ColourImage
    found: Detections


@dataclass
class LastImage:
    """Height and width of the last image, used to warm up new models; initially a common size.

    Written by the inference thread.
    """

    size_hw: tuple[int, int] = USUAL_SOURCE_HW


@dataclass(frozen=True)
class PointsWanted:
    """Which points of detected objects are published."""

    class_ids: frozenset[int] | None = None
    """None: of all classes."""
    spacing_m: float = 0.0
    """See `surface_points`."""

    def of(self, detections: Detections, placed: PlacedImage) -> Iterator[SurfacePoints]:
        """Those on the surfaces of `detections`, by object, with the index of the detection as its box."""
        is_wanted = [self.class_ids is None or one in self.class_ids for one in detections.class_ids.tolist()]
        rows = np.flatnonzero(is_wanted)
        surfaces = placed.surfaces[rows]
        for points in surface_points(surfaces, placed.depth, placed.camera, spacing_m=self.spacing_m):
            yield replace(points, box=int(rows[points.box]))


@dataclass(frozen=True)
class CameraPipeline:
    """One running configuration; immutable, so each frame uses exactly one. A change creates a new one.

    See `Pipeline` in `streaming.inference_threads`.
    """

    model: PreparedModel
    selection: Selection
    outputs: Outputs
    latencies: LatencyWindow
    empty_frames: EmptyFrames
    last_image: LastImage
    depth: DepthInput | None
    """None while the setting `depth` is false."""
    points: PointsWanted = PointsWanted()
    frame: FrameOutput | None = None
    """None for results in the frame of the camera."""
    tracking: TrackedDetection | None = None
    collecting: CameraCollecting | None = None
    """None while the setting `collect` is false."""

    @property
    def whole(self) -> Detector:
        return self.model.detector

    @property
    def parallel(self) -> Sequence[Detector]:
        return self.model.streams.detectors

    def detect(self, frame: ReceivedFrame, network: Detector) -> DetectedFrame:
        """Read the image, keep the depth image nearest to it, and detect objects.

        Raises ImageError for an unreadable image, which changes nothing.
        """
        image = messages.image_of_message(frame.message)
        self.last_image.size_hw = image.size_hw
        if self.depth is not None:
            self.depth.expect(frame.message.header)
        return DetectedFrame(frame, image, network.detect(image, self.wanted))

    @property
    def wanted(self) -> Selection:
        """What the detector should report for the next image.

        With a tracker, also detections that may continue a track; masks while a topic that shows them, or
        the places found with them, has a subscriber; what a look at the frame needs if it may be collected.
        """
        outputs = self.outputs
        others = outputs.image_subscribers if self.depth is None else outputs.place_subscribers
        selection = replace(self._selected, with_masks=outputs.mask_subscribers + others > 0)
        return selection if self.collecting is None else self.collecting.wanted(selection)

    @property
    def _selected(self) -> Selection:
        """What the tracker needs, or what is published without one."""
        return self.selection if self.tracking is None else self.tracking.wider(self.selection)

    def messages(self, result: DetectedFrame) -> Iterator[Send]:
        """The detections, then for subscribers their places, points, masks and the annotated image.

        The tracker is updated first: a tracker is used by frames of one network only, so not by two threads.
        """
        detections, header = result.found, result.frame.message.header
        if self.collecting is not None:
            detections = narrowed(detections, self._selected)
        if self.tracking is not None:
            stamp_s = messages.stamp_s(header)
            detections = self.tracking.follow(detections, result.image, self.selection, stamp_s)
        array = messages.detection_array(detections, self.whole.class_names, header)
        yield partial(self.outputs.detections.publish, array)
        now_s = time.monotonic()
        self.latencies.add(now_s, (now_s - result.frame.received_s) * 1e3)
        self.empty_frames.add(
            now_s, len(detections), best_missed=detections.best_missed, best_filtered=detections.best_filtered
        )
        # An image without depth gets no message: an empty one would mean that there are no objects.
        placed: PlacedImage | None = None
        if self.depth is not None and self.outputs.place_subscribers > 0:
            size_hw = result.image.size_hw
            placed = self.depth.place(detections.boxes_xyxy, size_hw, header, detections.masks)
        if placed is not None:
            yield from self._in_space(placed, detections, array, result.image)
        yield from self._images(result, detections, placed.distances_m if placed else ())
        if self.collecting is not None:
            jpeg = messages.jpeg_of_message(result.frame.message, result.image)
            origin = Origin(header.frame_id, header.stamp.sec, header.stamp.nanosec)
            self.collecting.look(result.found, detections, result.image, jpeg, origin)

    def _in_space(
        self, placed: PlacedImage, detections: Detections, array: Detection2DArray, image: ColourImage
    ) -> Iterator[Send]:
        """The detections in space and their points, each if it has a subscriber, in the frame that is set."""
        outputs, frame = self.outputs, self.frame
        header = Header(stamp=array.header.stamp, frame_id=frame.target_frame if frame else placed.frame_id)

        def sending(publisher: LifecyclePublisher, make: Callable[[Transform | None], Any]) -> Send:
            if frame is None:
                return partial(publisher.publish, make(None))
            return partial(frame.offer, header, placed.frame_id, lambda found: publisher.publish(make(found)))

        if outputs.subscribers_in_space[DETECTIONS_3D]:
            of_array = partial(messages.detection_3d_array_message, array, placed.placements, header.frame_id)
            yield sending(outputs.detections_3d, of_array)
        if outputs.subscribers_in_space[POINTS]:
            points = self.points.of(detections, placed)
            cloud = messages.point_cloud_message(points, detections, image, header)
            yield sending(outputs.points, partial(messages.moved_cloud, cloud))

    def _images(
        self, result: DetectedFrame, detections: Detections, distances_m: Sequence[float | None]
    ) -> Iterator[Send]:
        """The masks and the annotated image, each if it has a subscriber.

        A subscriber that joins after the detection may get no masks for this image.
        """
        header, has_viewers = result.frame.message.header, self.outputs.image_subscribers > 0
        has_mask_subscribers = self.outputs.mask_subscribers > 0
        label_image = detections.label_image() if has_mask_subscribers or has_viewers else None
        if has_mask_subscribers and label_image is not None:
            yield self.outputs.masks_message(label_image, header)
        if has_viewers:
            drawn = annotate(
                result.image,
                detections,
                self.whole.class_names,
                distances_m=distances_m,
                label_image=label_image,
                box_filter=self.selection.box_filter,
            )
            yield from self.outputs.image_messages(ColourImage(drawn, result.image.channel_order), header)


def label_info_publisher(node: LifecycleNode) -> LifecyclePublisher:
    """Latched publisher of the class names, one for all cameras. Raises rclpy's exception."""
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    return _created(node, LabelInfo, LABEL_INFO, latched)


@dataclass(eq=False)
class Outputs:
    """Owns the publishers of a camera's detections, points, masks and annotated images.

    `camera`: see `of_camera`. `on_subscribers_changed()` is called in the executor when a subscriber joins or
    leaves.

    Raises rclpy's exception if a publisher cannot be created, after destroying the others.
    """

    node: LifecycleNode
    _: KW_ONLY
    camera: str = ""
    on_subscribers_changed: Callable[[], None]

    def __post_init__(self) -> None:
        self._events = PublisherEventCallbacks(matched=lambda _: self.on_subscribers_changed())
        self._publishers: list[LifecyclePublisher] = []
        try:
            self.detections = self._publisher(Detection2DArray, DETECTIONS, depth=10)
            self.detections_3d = self._publisher(Detection3DArray, DETECTIONS_3D, depth=10)
            self.points = self._publisher(PointCloud2, POINTS, depth=1)
            self._masks = self._publisher(Image, MASKS, depth=1)
            self._image = self._publisher(Image, IMAGE, depth=1)
            self._compressed_image = self._publisher(CompressedImage, COMPRESSED_IMAGE, depth=1)
        except Exception:
            self.close()
            raise

    def subscribers(self, *, with_depth: bool, with_masks: bool) -> int:
        """Number of subscriptions that need inference: to outputs in space and masks only if these exist."""
        absent = [] if with_depth else [self.detections_3d, self.points]
        absent += [] if with_masks else [self._masks]
        needed = (publisher for publisher in self._publishers if publisher not in absent)
        return sum(publisher.get_subscription_count() for publisher in needed)

    @property
    def subscribers_in_space(self) -> dict[str, int]:
        """Number of subscriptions to detections and to points in space, by topic."""
        publishers = {DETECTIONS_3D: self.detections_3d, POINTS: self.points}
        return {topic: int(publisher.get_subscription_count()) for topic, publisher in publishers.items()}

    @property
    def place_subscribers(self) -> int:
        """Number of subscriptions that need to know where detections are: distances are drawn, too."""
        return self.image_subscribers + sum(self.subscribers_in_space.values())

    @property
    def mask_subscribers(self) -> int:
        """Number of subscriptions to masks."""
        return int(self._masks.get_subscription_count())

    @property
    def image_subscribers(self) -> int:
        """Number of subscriptions that need annotated images."""
        compressed = self._compressed_image.get_subscription_count()
        return int(self._image.get_subscription_count() + compressed)

    def masks_message(self, label_image: NDArray[np.uint16], header: Header) -> Send:
        """A message with the detection that each pixel (H, W) belongs to; see `Detections.label_image`."""
        return partial(self._masks.publish, messages.image_message(label_image, "16UC1", header))

    def image_messages(self, image: ColourImage, header: Header) -> Iterator[Send]:
        """Messages with an annotated image, raw and compressed, for each topic that has a subscriber."""
        if self._image.get_subscription_count():
            yield partial(
                self._image.publish, messages.image_message(image.pixels, f"{image.channel_order}8", header)
            )
        if self._compressed_image.get_subscription_count():
            try:
                jpeg = encode_jpeg(image)
            except ImageError as error:
                # The detections are published; only the compressed image is missing.
                self.node.get_logger().warning(
                    f"no image on {of_camera(COMPRESSED_IMAGE, self.camera)}: {error}",
                    throttle_duration_sec=5.0,
                )
                return
            message = messages.compressed_image_message(jpeg, f"{image.channel_order}8", header)
            yield partial(self._compressed_image.publish, message)

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in self._publishers:
            # destroy_publisher would leave it in the list of managed entities.
            self.node.destroy_lifecycle_publisher(publisher)
        self._publishers.clear()

    def _publisher(self, message_type: type, topic: str, *, depth: int) -> LifecyclePublisher:
        name = of_camera(topic, self.camera)
        publisher = _created(self.node, message_type, name, QoSProfile(depth=depth), self._events)
        self._publishers.append(publisher)
        return publisher


def _created(
    node: LifecycleNode,
    message_type: type,
    topic: str,
    qos: QoSProfile,
    events: PublisherEventCallbacks | None = None,
) -> LifecyclePublisher:
    return node.create_lifecycle_publisher(
        message_type,
        endpoint_name(node, topic),
        qos,
        event_callbacks=events,
        qos_overriding_options=overriding_options(node, topic, "publisher"),
    )
