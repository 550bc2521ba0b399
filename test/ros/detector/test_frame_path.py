"""A frame meets few files, and docs/architecture.md lists them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import pytest
from support.colcon_workspace import REPOSITORY
from support.detector_process import WEIGHTS, scene_image, scene_truth
from support.pages import spans, table
from support.runtime_names import EVERY_RUNTIME
from support.served_node import ServedNode

from yolov5_lifecycle.detection.prepared_model import prepare_model

PACKAGE = f"{REPOSITORY / 'yolov5_lifecycle'}/"
PAGE = REPOSITORY / "docs" / "architecture.md"
MAX_FILES, MAX_FILES_OF_TRACKER = 18, 7
LISTED = {row[0].strip("`") for row in table(PAGE, "One frame")}
OF_TRACKER = {span for span in spans(PAGE) if span.startswith("tracking/") and span.endswith(".py")}
LAYERS = {f"models/{name}.py" for name in ("convolutions", "bottlenecks", "partial", "pooling")}
"""What the layers of the model consist of; other models have other ones."""
OF_ENGINE = {f"runtimes/{name}.py" for name in ("compiled_runtime", "onnxruntime_runtime", "sparse_head")}
INSTEAD = {
    "onnxruntime": OF_ENGINE,
    "openvino": OF_ENGINE - {"runtimes/onnxruntime_runtime.py"} | {"runtimes/openvino_runtime.py"},
    "torch": {"runtimes/torch_runtime.py", "models/network.py", "models/head.py", *LAYERS},
}
"""What each runtime has in the place of `OF_ENGINE`."""


class CalledFiles:
    """The files of the package with a function that runs while `is_on`, in threads that begin after `noted`.

    In the inference thread all count; in the executor those that the callback for images calls.
    """

    def __init__(self) -> None:
        self.is_on = False
        self.files: set[str] = set()

    @contextmanager
    def noted(self) -> Iterator[None]:
        threading.setprofile(self._note)
        try:
            yield
        finally:
            threading.setprofile(None)

    def _note(self, frame: FrameType, event: str, _: object) -> None:
        if self.is_on and event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            callers = list(own_files(frame))
            if callers[-1] in ("streaming/worker.py", "ros/detector/image_input.py"):
                self.files.update(callers)


def own_files(frame: FrameType | None) -> Iterator[str]:
    """The package's files on the stack, innermost first."""
    while frame is not None:
        if frame.f_code.co_filename.startswith(PACKAGE):
            yield frame.f_code.co_filename.removeprefix(PACKAGE)
        frame = frame.f_back


def files_of_a_frame(*parameters: str) -> set[str]:
    """The files that the second image meets in a node with these `parameters`, on a CPU."""
    called = CalledFiles()
    parameters = (f"weights:={WEIGHTS}", "device:=cpu", "image_size:=320", *parameters)
    with called.noted(), ServedNode(prepare_model, parameters=parameters) as served:
        served.bring_to("active")
        served.publish(scene_image())  # what is imported or made once is not the way of a frame
        served.wait_for(lambda: len(served.detections) == 1, "the detections of the first image")
        called.is_on = True
        served.publish(scene_image())
        served.wait_for(lambda: len(served.detections) == 2, "the detections of the second image")
    assert len(served.detections[1].detections) >= len(scene_truth().scores) - 1
    return called.files


@pytest.mark.usefixtures("ros_domain")
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_the_files_that_a_frame_meets_are_those_of_the_page(runtime: str) -> None:
    files = files_of_a_frame(f"runtime:={runtime}")
    assert files == LISTED - OF_ENGINE | INSTEAD[runtime]
    assert len(files - LAYERS) <= MAX_FILES


@pytest.mark.usefixtures("ros_domain")
def test_with_a_tracker_a_frame_meets_the_files_of_the_page_besides() -> None:
    files = files_of_a_frame("runtime:=onnxruntime", "tracker:=bytetrack")
    assert files == LISTED | OF_TRACKER
    assert len(OF_TRACKER) <= MAX_FILES_OF_TRACKER
