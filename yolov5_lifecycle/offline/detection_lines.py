"""Detections as JSON lines: one object a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from yolov5_lifecycle.detections import Detections
from yolov5_lifecycle.found_objects import found_objects
from yolov5_lifecycle.images import Picture


def detection_line(
    identity: Mapping[str, str | int], picture: Picture, detections: Detections, class_names: Sequence[str]
) -> str:
    """`identity` of a picture, its size and what was found in it, boxes in its pixels, as a line of JSON."""
    height, width = picture.size_hw
    found = [
        {"class_name": one.class_name, "score": one.score, "box_xyxy": one.box_xyxy}
        for one in found_objects(detections, class_names)
    ]
    return json.dumps({**identity, "width": width, "height": height, "detections": found}) + "\n"
