"""Detection in a rosbag2 recording of images, with a recording of detections as output."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from rosbags.rosbag2 import Writer

from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.offline.detecting import Account, LoadDetector
from yolov5_lifecycle.offline.detection_bag import DetectionBag
from yolov5_lifecycle.offline.recording import ImageTopic, RecordedImage, RecordingError, open_recording


def detect_recording(
    source: Path, output: Path, *, topic: str | None, node: str, images: bool, load: LoadDetector
) -> Account:
    """Write the detections in the images of `source` to the new recording `output`, as the node `node`.

    Uses the storage format of the source. Raises RecordingError, OutputError, DetectingError and what `load`
    raises.
    """
    with open_recording(source) as recording, whole_output(output) as unfinished:
        image_topic = recording.image_topic(topic)
        images_of_topic = _not_empty(source, image_topic, recording.images(image_topic))
        detector = load()
        with Writer(unfinished, version=9, storage_plugin=recording.storage) as writer:
            bag = DetectionBag(
                writer,
                node=node,
                class_names=detector.class_names,
                threshold=detector.settings.confidence_threshold,
                images=images,
            )
            return detector.run(images_of_topic, expected=image_topic.count, write=bag.write)


def _not_empty(source: Path, topic: ImageTopic, images: Iterator[RecordedImage]) -> Iterator[RecordedImage]:
    """`images`, at least one; raises RecordingError if the topic was announced but has no messages."""
    first = next(images, None)
    if first is None:
        raise RecordingError(
            f"{source}: the topic {topic.name} is in it without a single message. "
            "Did the camera publish while it was recorded? `ros2 bag info` shows the counts."
        )
    return chain([first], images)
