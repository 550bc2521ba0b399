"""Detections, class names and images as messages, of ROS's classes or of others with the same fields.

`types` has the classes as attributes, as the module `vision_msgs.msg` does; each can be called with some of
its fields: the others have ROS's defaults.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import FoundObject


def detection_array(found: Sequence[FoundObject], header: Any, types: Any) -> Any:
    """Detection2DArray in source pixels, with the header of the source image."""
    return types.Detection2DArray(header=header, detections=[_detection(one, header, types) for one in found])


def _detection(found: FoundObject, header: Any, types: Any) -> Any:
    bbox = types.BoundingBox2D(size_x=found.size_xy[0], size_y=found.size_xy[1])
    bbox.center.position.x, bbox.center.position.y = found.centre_xy
    hypothesis = types.ObjectHypothesis(class_id=found.class_name, score=found.score)
    results = [types.ObjectHypothesisWithPose(hypothesis=hypothesis)]
    return types.Detection2D(header=header, results=results, bbox=bbox, id=found.track_id)


def label_info(class_names: Sequence[str], threshold: float, header: Any, types: Any) -> Any:
    """LabelInfo with the names of the classes by their ids, and the threshold of the scores."""
    classes = [types.VisionClass(class_id=index, class_name=name) for index, name in enumerate(class_names)]
    return types.LabelInfo(header=header, class_map=classes, threshold=threshold)


def image_fields(pixels: NDArray[Any], encoding: str) -> dict[str, Any]:
    """The fields of an Image of pixels (H, W) or (H, W, channels) but its header and its data."""
    height, width = pixels.shape[:2]
    step = pixels.nbytes // height
    return {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": step}
