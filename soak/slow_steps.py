"""Frames of which one step takes very long: scripted delays, and an image as large as an image may be."""

from __future__ import annotations

import os
import signal
import sys
import time
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from support.depth_messages import camera_info_message, depth_message
from support.detector_process import NODE, SCENE, environment

from soak import slow_detector, state_asker
from soak.finding import Finding, number_of, problem
from soak.largest_images import LARGEST_SIDE_PX
from soak.sender import TRANSPORTS
from soak.subject import Subject, subject_of
from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.child_process import ChildProcess, own_domain
from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S

_WEIGHTS = "package://yolov5_lifecycle/weights/shapes-seg.safetensors"
_STEP_PARAMETERS = {"depth": True, "tracker": "bytetrack", "image_transport": "compressed"}
_IMAGE_PARAMETERS = {"image_size": 1280, "confidence_threshold": 0.05, "image_transport": "compressed"}
_ANSWER_S = 1.0
_DEACTIVATE_S = REST_TIMEOUT_S + 1
_END_S = 5.0
_START_S = 60.0
_TILES = 5
"""The large image shows the scene this often along each side."""


@dataclass
class _Times:
    """The longest times so far, in seconds."""

    answer_s: float = 0.0
    deactivate_s: float = 0.0
    end_s: float = 0.0

    @property
    def are_short(self) -> bool:
        return self.answer_s < _ANSWER_S and self.deactivate_s < _DEACTIVATE_S and self.end_s < _END_S

    def __str__(self) -> str:
        answer, rest = f"get_state {self.answer_s:.2f} s", f"deactivate {self.deactivate_s:.1f} s"
        return f"{answer}, {rest}, SIGTERM {self.end_s:.1f} s"


def survived_slow_steps(
    steps: Sequence[str] = tuple(slow_detector.STEPS),
    *,
    side_px: int = LARGEST_SIDE_PX - 1,
    is_timed: bool = True,
) -> Finding:
    """Let every step of a frame take long once while the node deactivates and once when SIGTERM comes; then
    the same with a real image of `side_px` along each side and its masks. Times count only if `is_timed`."""
    times = _Times()
    trials: dict[str, Callable[[], None]] = {step: partial(_delay, step, times) for step in steps}
    trials["a real image"] = partial(_send_large, side_px, times)
    wrong = [f"{name}: {told}" for name, trial in trials.items() if (told := problem(trial))]
    return Finding(
        claim="whatever a frame does, the node answers, deactivates and ends",
        done=f"{', '.join(steps)} delayed; {side_px} x {side_px} pixels with {_TILES**2} scenes and masks",
        result=f"{number_of('other ends', wrong)}; at most {times}",
        limit=f"0; {_ANSWER_S:g}, {_DEACTIVATE_S:g}, {_END_S:g} s" if is_timed else "0",
        is_met=not wrong and (times.are_short or not is_timed),
    )


class _Viewer:
    """Sends compressed images and depth to `process`, and subscribes to all that is computed from them.

    `asker` asks for the state meanwhile.
    """

    def __init__(self, process: Subject, asker: ChildProcess) -> None:
        self.process = process
        self._asker = asker
        observer = process.observer
        self._images = observer.create_publisher(*TRANSPORTS["compressed"], 1)
        self._depth = observer.create_publisher(Image, f"{NODE}/depth/image_raw", 1)
        self._infos = observer.create_publisher(CameraInfo, f"{NODE}/depth/camera_info", 1)
        self.seen: dict[str, int] = dict.fromkeys(("masks", "image", "image/compressed"), 0)
        for topic in self.seen:
            kind = CompressedImage if topic.endswith("compressed") else Image
            observer.create_subscription(kind, f"{NODE}/{topic}", partial(self._see, topic), 1)

    def send(self, jpeg: CompressedImage) -> None:
        self._infos.publish(camera_info_message(0.0))
        self._depth.publish(depth_message(np.full(SCENE.size_hw, 2.0), 0.0))
        self._images.publish(jpeg)

    def see_all(self) -> None:
        """Send images until every topic has had one."""
        self.seen |= dict.fromkeys(self.seen, 0)
        self.send_until(lambda: all(self.seen.values()), "masks and annotated images")

    def send_until(self, condition: Callable[[], bool], what: str) -> None:
        jpeg = _jpeg(SCENE.frame(3)[0])

        def is_met() -> bool:
            self.send(jpeg)
            return condition()

        self.process.observer.wait_for(is_met, what)

    def deactivate(self, times: _Times) -> None:
        begun_s = time.monotonic()
        assert self.process.transition("deactivate")
        times.deactivate_s = max(times.deactivate_s, time.monotonic() - begun_s)

    def stop_asking(self, times: _Times) -> None:
        """Read how long the slowest answer took."""
        assert self._asker.stop(signal.SIGTERM, timeout_s=10 * _END_S) == 0
        answer_s = float(self._asker.output.rpartition(state_asker.LONGEST)[2].split()[0])
        times.answer_s = max(times.answer_s, answer_s)

    def _see(self, topic: str, _: object) -> None:
        self.seen[topic] += 1


def _delay(step: str, times: _Times) -> None:
    with _viewer([slow_detector.__file__, step], _STEP_PARAMETERS) as viewer:
        process = viewer.process
        for is_last in (False, True):
            process.bring_to("active")
            viewer.see_all()
            os.kill(process.process.process_id, signal.SIGUSR1)
            viewer.send_until(lambda: "If inference hangs" in process.status()["message"], f"{step} to hang")
            if not is_last:
                viewer.deactivate(times)
        viewer.stop_asking(times)
        _terminate(process, times)


def _send_large(side_px: int, times: _Times) -> None:
    jpeg = _jpeg(_tiled(SCENE.frame(3)[0], side_px))
    with _viewer([slow_detector.__file__, "decoding"], _IMAGE_PARAMETERS) as viewer:
        process = viewer.process
        for is_last in (False, True):
            process.bring_to("active")
            viewer.see_all()
            viewer.send(jpeg)
            process.observer.wait_for(
                lambda: any(len(array.detections) > _TILES**2 for array in process.detections),
                "its detections",
            )
            if not is_last:
                viewer.deactivate(times)
        viewer.stop_asking(times)
        _terminate(process, times)


def _terminate(process: Subject, times: _Times) -> None:
    begun_s = time.monotonic()
    code = process.process.stop(signal.SIGTERM, timeout_s=10 * _END_S)
    times.end_s = max(times.end_s, time.monotonic() - begun_s)
    assert (code, process.escaped) == (0, []), f"exit code {code}, {process.escaped}"


@contextmanager
def _viewer(program: Sequence[str], parameters: Mapping[str, object]) -> Iterator[_Viewer]:
    given = {"weights": _WEIGHTS, "device": "cpu", **parameters}
    asking = [sys.executable, state_asker.__file__, NODE]
    with (
        own_domain() as domain,
        subject_of(program, given, domain) as process,
        ChildProcess("asker", asking, environment(domain)) as asker,
    ):
        asker.wait_for_output("asking", _START_S)
        yield _Viewer(process, asker)


def _tiled(pixels: NDArray[np.uint8], side_px: int) -> NDArray[np.uint8]:
    """An RGB image (side, side, 3) that shows `pixels` in _TILES rows and columns."""
    tile = cv2.resize(pixels, (side_px // _TILES,) * 2)
    rest_px = side_px - _TILES * len(tile)
    return np.pad(np.tile(tile, (_TILES, _TILES, 1)), ((0, rest_px), (0, rest_px), (0, 0)), mode="edge")


def _jpeg(pixels: NDArray[np.uint8]) -> CompressedImage:
    data = encode_jpeg(ColourImage(pixels, "rgb"))
    return CompressedImage(format="jpeg", data=array("B", data.tobytes()))
