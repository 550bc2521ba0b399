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
    "working_frame": "target_frame",
    "use_tracking": "tracker",
    "minimum_probability": "confidence_threshold",
    "interested_classes": "classes",
    "roi": "regions",
    "rois": "regions",
    "zones": "regions",
}
"""Names that YOLOv5's own scripts and other nodes use for a setting."""

_TOPIC = "topics are remapped: -r '~/image_raw:=/camera/image_raw'."
_DEPTH_TOPICS = (
    "topics are remapped: -r '~/depth/image_raw:=/camera/depth/image_raw', and ~/depth/camera_info."
)
_OFFERED = "none is needed, because the reliability of depth is that of its publishers."
_IN_PIXELS = "none is needed, because detections are in pixels; depth has its own, on ~/depth/camera_info."
_NO_LIMIT = "none is needed, because the surface of an object is found without a limit in metres."
_ENCODED = "none is needed, because the unit follows from the encoding of the depth image."
_BOND = "set bond_timeout to enable the bond; heartbeats are sent every 0.1 s."
_SWITCH = "none is needed, because ~/image is published while it has subscribers."
NOT_SETTINGS = {
    "image_topic": _TOPIC,
    "input_topic": _TOPIC,
    "camera_topic": _TOPIC,
    "input_image_topic": _TOPIC,
    "pub_image": _SWITCH,
    "pub_result_img": _SWITCH,
    "publish_image": _SWITCH,
    "show_result": _SWITCH,
    "use_debug": _SWITCH,
    "pub_boxes": "none is needed, because what has no subscriber is not published.",
    "enable": "deactivate and activate the node: ros2 lifecycle set /yolov5 deactivate.",
    "namespace": "it is remapped: -r __ns:=/robot.",
    "input_depth_topic": _DEPTH_TOPICS,
    "input_depth_info_topic": _DEPTH_TOPICS,
    "point_cloud_topic": _DEPTH_TOPICS,
    "maximum_detection_threshold": _NO_LIMIT,
    "depth_image_units_divisor": _ENCODED,
    "depth_image_reliability": _OFFERED,
    "depth_info_reliability": _OFFERED,
    "camera_info_topic": _IN_PIXELS,
    "camera_info_file": _IN_PIXELS,
    "retina_masks": "none is needed, because masks always have the size of the image.",
    "yolo_encoding": "none is needed, because each image names its encoding.",
    "fuse_model": "none is needed, because convolutions and batch normalizations are always fused.",
    "model_type": "none is needed, because every model is a YOLOv5.",
    "augment": "images are detected once, without test-time augmentation.",
    "bond_heartbeat_period": _BOND,
}
"""Parameters of other nodes that this node lacks, with what to do instead."""

QOS_PREFIX = "qos_overrides."
ROS_PREFIXES = ("use_sim_time", QOS_PREFIX, "start_type_description_service")
"""What the names of the parameters that ROS declares on every node begin with."""
