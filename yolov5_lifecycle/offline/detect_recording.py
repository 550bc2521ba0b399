"""Detection in a rosbag2 recording of images, written as a recording of what the node would publish."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from yolov5_lifecycle.atomic_file import OutputError
from yolov5_lifecycle.detection.box_filter import BoxFilter
from yolov5_lifecycle.detection.detections import Detections, FoundObject
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import LoadDetector, RunStatistics
from yolov5_lifecycle.offline.export.crops import Crops
from yolov5_lifecycle.offline.export.detected_image import DetectedImage
from yolov5_lifecycle.offline.export.exporting import Export, export_images, whole_export
from yolov5_lifecycle.offline.recording import (
    TYPES,
    RecordedImage,
    RecordedTopic,
    Recording,
    RecordingError,
    open_recording,
)
from yolov5_lifecycle.offline.sqlite_path import UriPath
from yolov5_lifecycle.offline.terminal import missing_images
from yolov5_lifecycle.printable import in_one_line, is_utf8
from yolov5_lifecycle.process.standard_streams import complain

_DETECTIONS = "vision_msgs/msg/Detection2DArray"
_LABELS = "vision_msgs/msg/LabelInfo"
_IMAGE = "sensor_msgs/msg/Image"


@dataclass(frozen=True)
class RecordingOptions:
    """The topic of the images, None for the only one, and what a new recording has, named as by `node`."""

    topic: str | None
    node: str
    images: bool
    """Whether it has annotated images."""


def detect_recording(
    source: Path, export: Export, options: RecordingOptions, load: LoadDetector
) -> RunStatistics:
    """`write_detections`, with outputs that appear when they are complete, or not at all.

    Raises RecordingError, OutputError, DetectingError and what `load` raises.
    """
    with open_recording(source) as recording, whole_export(export) as unfinished:
        if recording.foreign:
            complain("detect_bag", f"{source}: left out, not of ROS 2: {recording.foreign}")
        return write_detections(recording, unfinished, options, load)


def write_detections(
    recording: Recording, export: Export, options: RecordingOptions, load: LoadDetector
) -> RunStatistics:
    """Write the detections in the images of `recording`; what is written stays on failure.

    Without a suffix in `export`, the output is a new recording in the storage format of `recording`. Also
    raises OSError.
    """
    topic = recording.image_topic(options.topic)
    images = _not_empty(recording.path, topic, recording.images(topic))
    if export.suffix:
        statistics = export_images(images, topic.count, export, load=load)
    else:
        statistics = _write_recording(recording, images, topic.count, export, options, load)
    statistics.missing = max(0, topic.count - statistics.balance.received)
    return statistics


def _write_recording(
    recording: Recording,
    images: Iterator[RecordedImage],
    expected: int,
    export: Export,
    options: RecordingOptions,
    load: LoadDetector,
) -> RunStatistics:
    assert export.path is not None
    _check_name(export.path)
    detector = load()
    with (
        os_errors(export.path),
        _Writer(export.path, version=9, storage_plugin=recording.storage) as writer,
    ):
        bag = DetectionBag(
            writer,
            node=options.node,
            class_names=detector.class_names,
            threshold=detector.settings.confidence_threshold,
            box_filter=detector.box_filter,
            images=options.images,
            masks=export.masks and detector.segments,
        )
        crops = None if export.crops is None else Crops(export.crops, detector.class_names)

        def write(recorded: RecordedImage, image: ColourImage, detections: Detections) -> None:
            bag.write(recorded, image, detections)
            if crops is not None:
                crops.add(DetectedImage(recorded, image, detections))

        return detector.run(images, expected=expected, write=write)


class _SqliteWriter(Sqlite3Writer):
    """Writes to its path, whatever characters the path has."""

    def __init__(self, path: Path, compression: Any) -> None:
        super().__init__(UriPath(path), compression)


class _Writer(Writer):
    STORAGE_PLUGINS: Mapping[Any, Any] = {**Writer.STORAGE_PLUGINS, StoragePlugin.SQLITE3: _SqliteWriter}


def _check_name(output: Path) -> None:
    """Raise OutputError if metadata.yaml cannot contain the name of the recording `output`."""
    if not is_utf8(output.name):
        name = in_one_line(output.name)
        raise OutputError(f"{name}: the name of a recording must be UTF-8: choose another --output.")


@contextmanager
def os_errors(output: Path) -> Iterator[None]:
    """Raise OSError for an error of SQLite while it writes to `output`, with ENOSPC if the disk is full."""
    try:
        yield
    except sqlite3.Error as error:
        # Its code is an attribute only since Python 3.11; the text of SQLITE_FULL is fixed.
        is_full = str(error) == "database or disk is full"
        raise OSError(errno.ENOSPC if is_full else errno.EIO, str(error), str(output)) from error


def _not_empty(
    source: Path, topic: RecordedTopic, images: Iterator[RecordedImage]
) -> Iterator[RecordedImage]:
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


class DetectionBag:
    """Adds detections, labels and, with `images`, annotated images to the recording of `writer`.

    With `masks`, masks too, as label images; all detections must then have masks. Topics and QoS are those of
    the node named `node`.
    """

    def __init__(
        self,
        writer: Writer,
        *,
        node: str,
        class_names: Sequence[str],
        threshold: float,
        box_filter: BoxFilter | None,
        images: bool,
        masks: bool,
    ) -> None:
        self._writer = writer
        self._class_names = class_names
        self._threshold = threshold
        self._box_filter = box_filter
        self._is_labelled = False
        self._labels = self._topic(f"{node}/label_info", _LABELS, depth=1, durability=_LATCHED)
        self._detections = self._topic(f"{node}/detections", _DETECTIONS, depth=10)
        self._images = self._topic(f"{node}/image", _IMAGE, depth=1) if images else None
        self._masks = self._topic(f"{node}/masks", _IMAGE, depth=1) if masks else None

    def write(self, recorded: RecordedImage, image: ColourImage, detections: Detections) -> None:
        """Write the node's messages for `recorded`, with its header and at the time of its recording."""
        timestamp_ns, header = recorded.timestamp_ns, recorded.message.header
        if not self._is_labelled:
            labels = _label_info(self._class_names, self._threshold, header.stamp)
            self._add(self._labels, timestamp_ns, labels)
            self._is_labelled = True
        found = detections.objects(self._class_names)
        self._add(self._detections, timestamp_ns, detection_array(found, header))
        labels = detections.label_image()
        if self._masks is not None and labels is not None:
            self._add(self._masks, timestamp_ns, _image(labels.astype("<u2"), "16UC1", header))
        if self._images is not None:
            drawn = annotate(
                image, detections, self._class_names, label_image=labels, box_filter=self._box_filter
            )
            self._add(self._images, timestamp_ns, _image(drawn, f"{image.order}8", header))

    def _topic(
        self, name: str, type_name: str, *, depth: int, durability: QosDurability = QosDurability.VOLATILE
    ) -> Any:
        return self._writer.add_connection(
            name, type_name, typestore=TYPES, offered_qos_profiles=[_qos(depth, durability)]
        )

    def _add(self, connection: Any, timestamp_ns: int, message: Any) -> None:
        data = TYPES.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, timestamp_ns, data)


def detection_array(found: Sequence[FoundObject], header: Any) -> Any:
    """A vision_msgs/Detection2DArray as a rosbags object, with the header of the image."""
    return _new(_DETECTIONS, header=header, detections=[_detection(one, header) for one in found])


def _detection(found: FoundObject, header: Any) -> Any:
    position = _new("vision_msgs/msg/Point2D", x=found.centre_xy[0], y=found.centre_xy[1])
    centre = _new("vision_msgs/msg/Pose2D", position=position, theta=0.0)
    hypothesis = _new("vision_msgs/msg/ObjectHypothesis", class_id=found.class_name, score=found.score)
    return _new(
        "vision_msgs/msg/Detection2D",
        header=header,
        results=[_new("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=_no_pose())],
        bbox=_new(
            "vision_msgs/msg/BoundingBox2D", center=centre, size_x=found.size_xy[0], size_y=found.size_xy[1]
        ),
        id=found.track_id,
    )


def _no_pose() -> Any:
    """A pose with ROS's default values."""
    pose = _new(
        "geometry_msgs/msg/Pose",
        position=_new("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
        orientation=_new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    return _new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))


def _label_info(class_names: Sequence[str], threshold: float, stamp: Any) -> Any:
    return _new(
        _LABELS,
        header=_new("std_msgs/msg/Header", stamp=stamp, frame_id=""),
        class_map=[
            _new("vision_msgs/msg/VisionClass", class_id=index, class_name=name)
            for index, name in enumerate(class_names)
        ],
        threshold=threshold,
    )


def _image(pixels: NDArray[np.uint8 | np.uint16], encoding: str, header: Any) -> Any:
    height, width = pixels.shape[:2]
    return _new(
        _IMAGE,
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=pixels.nbytes // height,
        data=np.ascontiguousarray(pixels).reshape(-1).view(np.uint8),
    )


def _new(type_name: str, **fields: Any) -> Any:
    return TYPES.types[type_name](**fields)


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
