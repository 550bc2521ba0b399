"""Which frames may run in one batch."""

from __future__ import annotations

from typing import cast

from support.preparations import Preparations
from support.served_node import image

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.ros.detector.batch_detection import BatchDetection
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.ros.detector.pipeline import LastImage, Pipeline
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import EmptyFrames, EmptyRun, LatencyWindow

NO_OUTPUTS = cast(Outputs, None)
"""Nothing is published here."""


def pipeline_of(detector: Detector) -> Pipeline:
    return Pipeline(
        detector,
        Selection(),
        NO_OUTPUTS,
        LatencyWindow(),
        EmptyFrames(EmptyRun(0.25)),
        LastImage(),
        placing=None,
    )


def test_a_frame_of_a_removed_camera_does_not_run_in_a_batch_of_the_next_model() -> None:
    """Its pipeline would publish the detections with the class names of the previous model."""
    prepare = Preparations()
    previous, following = (prepare(Settings(), []).detector for _ in range(2))
    batch, frame = BatchDetection(following), ReceivedFrame(image(), 0.0)
    assert batch.key(pipeline_of(following), frame) == (480, 640)
    assert batch.key(pipeline_of(previous), frame) is None
