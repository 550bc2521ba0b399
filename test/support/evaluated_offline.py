"""The command `evaluate` with the embedded model, and labelled data of the scene."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import StoragePlugin, Writer

from support.colcon_workspace import REPOSITORY
from support.detected_offline import prepare_once
from support.recorded_scene import IMAGE, TOPIC, raw, recorded_ns, shown
from tools.shapes.dataset import write_dataset
from yolov5_lifecycle.detection.detections import FoundObject
from yolov5_lifecycle.offline.detect_recording import detection_array
from yolov5_lifecycle.offline.evaluate.command import main
from yolov5_lifecycle.offline.recording import TYPES
from yolov5_lifecycle.sources.scene import CLASS_NAMES

WEIGHTS = str(REPOSITORY / "weights" / "shapes.safetensors")
FAST = ["--set", "image_size=320", "--set", "device=cpu", "--set", "runtime=onnxruntime"]
TRUTH = "/yolov5/detections"

run = functools.partial(main, prepare=prepare_once)


def evaluate(data: Path, *words: str) -> int:
    """The exit code of `evaluate` for the embedded model."""
    return run([WEIGHTS, str(data), *FAST, *words])


def report_of(folder: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((folder / "report.json").read_text(), parse_constant=_no_number)
    return report


def _no_number(text: str) -> None:
    raise AssertionError(f"JSON has no {text}")


def shapes(folder: Path, images: int = 24) -> Path:
    """A new data set of shapes in YOLO format."""
    write_dataset(folder, images=images)
    return folder


def as_coco(data: Path) -> Path:
    """The data set of shapes `data` as a file in COCO format, written beside its images."""
    size_hw = (256, 320)
    images, annotations = [], []
    for number, label_file in enumerate(sorted((data / "labels" / "val").iterdir())):
        name = f"images/val/{label_file.stem}.jpg"
        images.append({"id": number, "file_name": name, "height": size_hw[0], "width": size_hw[1]})
        for line in label_file.read_text().splitlines():
            class_id, cx, cy, width, height = map(float, line.split())
            fractions = (cx - width / 2, cy - height / 2, width, height)
            bbox = [part * side for part, side in zip(fractions, size_hw[::-1] * 2, strict=True)]
            annotations.append({"image_id": number, "category_id": 10 + int(class_id), "bbox": bbox})
    categories = [{"id": 10 + number, "name": name} for number, name in enumerate(CLASS_NAMES)]
    path = data / "truth.json"
    path.write_text(json.dumps({"images": images, "annotations": annotations, "categories": categories}))
    return path


def truth_of(number: int) -> list[FoundObject]:
    """What image `number` of the scene shows."""
    _, truth = shown(number)
    return [
        FoundObject(CLASS_NAMES[class_id], 1.0, tuple(box))
        for class_id, box in zip(truth.class_ids.tolist(), truth.boxes_xyxy.tolist(), strict=True)
    ]


def labelled_drive(
    path: Path,
    numbers: Sequence[int] = range(3),
    *,
    labelled: Sequence[int] = range(3),
    class_names: Sequence[str] | None = CLASS_NAMES,
    change: Callable[[Any], Any] = lambda message: message,
    topics: Sequence[str] = (TRUTH,),
    other_names: Sequence[str] | None = None,
) -> Path:
    """A recording of the images `numbers`, and on `topics` what those of `labelled` show, after `change`.

    `other_names`: the classes in the label_info of another node, which comes first by name.
    """
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        image_topic = writer.add_connection(TOPIC, IMAGE, typestore=TYPES)
        for number in numbers:
            _add(writer, image_topic, number, raw(number))
        for topic in topics:
            connection = writer.add_connection(topic, "vision_msgs/msg/Detection2DArray", typestore=TYPES)
            for number in labelled:
                message = change(detection_array(truth_of(number), raw(number).header))
                _add(writer, connection, number, message)
        for node, names in (("faces", other_names), ("yolov5", class_names)):
            if names is not None:
                connection = writer.add_connection(
                    f"/{node}/label_info", "vision_msgs/msg/LabelInfo", typestore=TYPES
                )
                _add(writer, connection, 0, _label_info(names))
    return path


def _add(writer: Writer, connection: Any, number: int, message: Any) -> None:
    data = message if isinstance(message, bytes) else TYPES.serialize_cdr(message, connection.msgtype)
    writer.write(connection, recorded_ns(number), data)


def _label_info(class_names: Sequence[str]) -> Any:
    vision_class = TYPES.types["vision_msgs/msg/VisionClass"]
    return TYPES.types["vision_msgs/msg/LabelInfo"](
        header=raw(0).header,
        class_map=[vision_class(class_id=number, class_name=name) for number, name in enumerate(class_names)],
        threshold=0.25,
    )
