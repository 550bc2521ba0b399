"""Names of parameters that are not settings of the detector: those of other software, and of ROS itself."""

from __future__ import annotations

SYNONYMS = {
    "half": "precision",
    "conf": "confidence_threshold",
    "conf_thres": "confidence_threshold",
    "threshold": "confidence_threshold",
    "iou": "iou_threshold",
    "iou_thres": "iou_threshold",
    "nms_threshold": "iou_threshold",
    "imgsz": "image_size",
    "imgsz_height": "image_size",
    "imgsz_width": "image_size",
    "max_det": "max_detections",
    "model": "weights",
    "model_file": "weights",
    "model_path": "weights",
    "weights_url": "weights",
    "use_3d": "depth",
    "roi": "regions",
    "rois": "regions",
    "zones": "regions",
}
"""Names that YOLOv5's own scripts and other nodes use for a setting."""

_TOPIC = "topics are remapped: -r '~/image_raw:=/camera/image_raw'."
_BOND = "set bond_timeout to enable the bond; heartbeats are sent every 0.1 s."
_SWITCH = "not needed: ~/image is published while it has subscribers."
NOT_SETTINGS = {
    "image_topic": _TOPIC,
    "input_topic": _TOPIC,
    "camera_topic": _TOPIC,
    "input_image_topic": _TOPIC,
    "pub_image": _SWITCH,
    "pub_result_img": _SWITCH,
    "publish_image": _SWITCH,
    "show_result": _SWITCH,
    "bond_heartbeat_period": _BOND,
}
"""Parameters of other nodes that this node lacks, with what to do instead."""

QOS_PREFIX = "qos_overrides."
ROS_PREFIXES = ("use_sim_time", QOS_PREFIX, "start_type_description_service")
"""What the names of the parameters that ROS declares on every node begin with."""
