"""The status of a node that detects as it should."""

from __future__ import annotations

from dataclasses import replace

from rclpy.qos import ReliabilityPolicy

from yolov5_lifecycle.collecting.collector import CollectorStatus
from yolov5_lifecycle.ros.detector.camera_status import CameraStatus
from yolov5_lifecycle.ros.detector.depth import DepthCounts, DepthStatus, SourceStatus
from yolov5_lifecycle.ros.detector.diagnostics import Status
from yolov5_lifecycle.ros.detector.image_input import InputStatus
from yolov5_lifecycle.ros.detector.image_topic import TopicStatus
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import EmptyRun, FrameCounter, LatencySummary

LARGE = 921_600
TOPIC = TopicStatus(name="/yolov5/image_raw", reliabilities=(ReliabilityPolicy.BEST_EFFORT,))
GOOD_INPUT = InputStatus(
    reliability=ReliabilityPolicy.BEST_EFFORT,
    silent_s=0.1,
    window_s=5.0,
    received=150,
    lost=1,
    max_bytes=LARGE,
)
SOURCE = SourceStatus("/yolov5/depth/image_raw", publishers=1, missing_s=0.0)
GOOD_CAMERA = CameraStatus(
    camera="",
    problem="",
    last_problem="",
    recent_failure="",
    balance=FrameCounter().balance(),
    topic=TOPIC,
    input=GOOD_INPUT,
    lost=3,
    dropped_in_queue=7,
    latency=LatencySummary(29.9, 21.0, 30.5),
    empty=EmptyRun(0.9),
    tracking={
        "tracker": "bytetrack",
        "confirmed tracks": "6",
        "late images not tracked": "2",
        "jumps back in time": "1",
    },
    depth_status=DepthStatus(
        image=SOURCE, camera_info=SOURCE, counts=DepthCounts(), run=None, recently_rejected=""
    ),
    subscribers_3d=1,
    segments=True,
    mask_subscribers=1,
    busy_s=0.02,
    collecting_problem="",
)
GOOD = Status(
    state="active",
    problem="",
    settings=Settings(),
    model=None,
    cameras=(GOOD_CAMERA,),
    abandoned_threads=0,
    resident_mb=350.4,
    collected=CollectorStatus(kept=3, duplicates=5, frames=12, megabytes=4.2),
)
OF_CAMERAS = replace(GOOD, cameras=(replace(GOOD_CAMERA, camera="front"),))
"""The same of a node whose camera has a name."""
