"""From a recording with images to a recording with detections."""

from __future__ import annotations

from pathlib import Path

from rosbags.rosbag2 import Writer

from yolov5_lifecycle.offline.detecting import Account, LoadDetector
from yolov5_lifecycle.offline.detection_bag import DetectionBag
from yolov5_lifecycle.offline.recording import open_recording
from yolov5_lifecycle.offline.whole_output import whole_output


def detect_recording(
    source: Path, output: Path, *, topic: str | None, node: str, images: bool, load: LoadDetector
) -> Account:
    """Write to the new recording `output` what the node called `node` makes of the images in `source`.

    It is stored as the source is. Raises RecordingError, OutputError, DetectingError and what `load` raises.
    """
    with open_recording(source) as recording, whole_output(output) as unfinished:
        image_topic = recording.image_topic(topic)
        detector = load()
        with Writer(unfinished, version=9, storage_plugin=recording.storage) as writer:
            bag = DetectionBag(
                writer,
                node=node,
                class_names=detector.class_names,
                threshold=detector.settings.confidence_threshold,
                images=images,
            )
            return detector.run(recording.images(image_topic), expected=image_topic.count, write=bag.write)
