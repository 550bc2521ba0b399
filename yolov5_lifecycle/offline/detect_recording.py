"""Detection in a rosbag2 recording of images, written as a recording of what the node would publish."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Nodetype,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from yolov5_lifecycle.atomic_file import OutputError
from yolov5_lifecycle.detection.messages import detection_array, image_fields, label_info
from yolov5_lifecycle.offline.detecting import LoadDetector, OfflineDetector, RunStatistics
from yolov5_lifecycle.offline.export.exporting import Export, export_images
from yolov5_lifecycle.offline.export.formats import DetectedImage, Write
from yolov5_lifecycle.offline.recording import TYPES, RecordedMessage, RecordingError, open_recording
from yolov5_lifecycle.offline.stored_messages import StoredTopic
from yolov5_lifecycle.offline.terminal import missing_images
from yolov5_lifecycle.printable import in_one_line, is_utf8

_DETECTIONS = "vision_msgs/msg/Detection2DArray"
_LABELS = "vision_msgs/msg/LabelInfo"
_IMAGE = "sensor_msgs/msg/Image"
_POSE = "geometry_msgs/msg/PoseWithCovariance"


def write_recording(source: Path, export: Export, load: LoadDetector) -> RunStatistics:
    """Write the detections in the images of the recording `source`; what is written stays on failure.

    Without a suffix in `export`, the output is a new recording in MCAP. Raises RecordingError, OutputError,
    OSError, DetectingError and what `load` raises.
    """
    with open_recording(source) as recording:
        topic = recording.image_topic(export.topic)
        images = _not_empty(source, topic, recording.messages(topic))
        if not export.suffix and export.path is not None and not is_utf8(export.path.name):
            name = in_one_line(export.path.name)
            raise OutputError(f"{name}: the name of a recording must be UTF-8: choose another --output.")
        new_bag = None if export.suffix else partial(_detection_bag, export)
        statistics = export_images(images, topic.count, export, load, new_bag)
    statistics.missing = max(0, topic.count - statistics.outcomes.total())
    return statistics


def _not_empty(
    source: Path, topic: StoredTopic, images: Iterator[RecordedMessage]
) -> Iterator[RecordedMessage]:
    """`images`, at least one; raises RecordingError if the topic was announced but has no messages."""
    first = next(images, None)
    if first is None:
        raise RecordingError(
            f"{source}: the topic {topic.name} has no messages. "
            "Did the camera publish during the recording? `ros2 bag info` shows the counts."
            if not topic.count
            else f"{source}: {missing_images(topic.count, 0)}"
        )
    return chain([first], images)


@contextmanager
def _detection_bag(export: Export, detector: OfflineDetector) -> Iterator[Write]:
    """The new recording of `export`."""
    assert export.path is not None
    with Writer(export.path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        yield _DetectionBag(writer, export, detector).write


class _DetectionBag:
    """The topics of the node in a new recording, with its QoS; masks are label images."""

    def __init__(self, writer: Writer, export: Export, detector: OfflineDetector) -> None:
        self._writer = writer
        self._detector = detector
        self._is_labelled = False
        node, has_masks = export.node, export.masks and detector.segments
        self._labels = self._topic(f"{node}/label_info", _LABELS, depth=1, durability=_LATCHED)
        self._detections = self._topic(f"{node}/detections", _DETECTIONS, depth=10)
        self._images = self._topic(f"{node}/image", _IMAGE, depth=1) if export.images else None
        self._masks = self._topic(f"{node}/masks", _IMAGE, depth=1) if has_masks else None

    def write(self, found: DetectedImage) -> None:
        """Write the node's messages for a recorded image, with its header and time of recording."""
        recorded: Any = found.stored
        timestamp_ns, header = recorded.timestamp_ns, recorded.message.header
        class_names = self._detector.class_names
        if not self._is_labelled:
            threshold = self._detector.settings.confidence_threshold
            of_labels = _new("std_msgs/msg/Header", stamp=header.stamp, frame_id="")
            self._add(self._labels, timestamp_ns, label_info(class_names, threshold, of_labels, _TYPES))
            self._is_labelled = True
        array = detection_array(found.detections.objects(class_names), header, _TYPES)
        self._add(self._detections, timestamp_ns, array)
        labels = found.detections.label_image()
        if self._masks is not None and labels is not None:
            self._add(self._masks, timestamp_ns, _image(labels.astype("<u2"), "16UC1", header))
        if self._images is not None:
            drawn = self._detector.drawn(found.image, found.detections, labels)
            self._add(self._images, timestamp_ns, _image(drawn.pixels, f"{drawn.channel_order}8", header))

    def _topic(
        self, name: str, type_name: str, *, depth: int, durability: QosDurability = QosDurability.VOLATILE
    ) -> Any:
        return self._writer.add_connection(
            name, type_name, typestore=TYPES, offered_qos_profiles=[_qos(depth, durability)]
        )

    def _add(self, connection: Any, timestamp_ns: int, message: Any) -> None:
        data = TYPES.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, timestamp_ns, data)


def _new(type_name: str, **fields: Any) -> Any:
    """A message with these fields; the others, which are numbers, have ROS's default values."""
    if type_name == "geometry_msgs/msg/Quaternion":
        fields = {"w": 1.0, **fields}
    for name, (kind, of) in TYPES.fielddefs[type_name][1]:
        if name not in fields:
            fields[name] = _default(kind, of)
    return TYPES.types[type_name](**fields)


def _default(kind: Nodetype, of: Any) -> Any:
    if kind is Nodetype.NAME:
        return _no_pose() if of == _POSE else _new(of)
    return np.zeros(of[1]) if kind is Nodetype.ARRAY else 0.0


@cache
def _no_pose() -> Any:
    """One for all detections, as it takes half of their time; nobody changes it."""
    return _new(_POSE)


class _VisionTypes:
    """The classes of vision_msgs by name, as in ROS."""

    def __getattr__(self, name: str) -> Any:
        return partial(_new, f"vision_msgs/msg/{name}")


_TYPES = _VisionTypes()


def _image(pixels: NDArray[np.uint8 | np.uint16], encoding: str, header: Any) -> Any:
    data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    return _new(_IMAGE, header=header, data=data, **image_fields(pixels, encoding))


_LATCHED = QosDurability.TRANSIENT_LOCAL
_ANY_TIME = QosTime(0, 0)


def _qos(depth: int, durability: QosDurability) -> Qos:
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE,
        durability=durability,
        deadline=_ANY_TIME,
        lifespan=_ANY_TIME,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_ANY_TIME,
        avoid_ros_namespace_conventions=False,
    )
