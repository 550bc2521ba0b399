"""The real detector with a real segmentation model; SIGUSR1 makes one step of its next frame take very long.

Runs as a separate process. The first argument names the step, see `STEPS`.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.memory import prepare_heap

if __name__ == "__main__":
    prepare_environment()
    prepare_heap()  # as in the installed command, before the imports below start threads

from rclpy.lifecycle import LifecyclePublisher

from yolov5_lifecycle.detection import detector
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.detector import outputs, pipeline
from yolov5_lifecycle.ros.detector.command import main
from yolov5_lifecycle.ros.detector.depth import DepthInput
from yolov5_lifecycle.runtimes.compiled_runtime import CompiledRuntime
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker

STEPS: dict[str, tuple[Any, str]] = {
    "decoding": (messages, "image_of_message"),
    "inference": (CompiledRuntime, "__call__"),
    "NMS": (detector, "select"),
    "tracking": (ByteTracker, "update"),
    "placing": (DepthInput, "place"),
    "masks": (Masks, "label_image"),
    "drawing": (pipeline, "annotate"),
    "compressing": (outputs, "compressed_image_message"),
    "publishing": (LifecyclePublisher, "publish"),
}
"""Where each step of a frame is: the owner of a function, and its name."""
LONG_S = 120.0


def _delayed(original: Callable[..., Any], is_armed: threading.Event) -> Callable[..., Any]:
    """`original`, which the inference thread enters late once after each `is_armed`."""

    def step(*arguments: Any, **options: Any) -> Any:
        if is_armed.is_set() and threading.current_thread().name == "inference":
            is_armed.clear()
            time.sleep(LONG_S)
        return original(*arguments, **options)

    return step


def _delay(step: str) -> None:
    owner, name = STEPS[step]
    is_armed = threading.Event()
    setattr(owner, name, _delayed(getattr(owner, name), is_armed))
    signal.signal(signal.SIGUSR1, lambda *_: is_armed.set())


if __name__ == "__main__":
    _delay(sys.argv[1])
    main(["detector", *sys.argv[2:]])
