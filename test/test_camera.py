"""The camera: its sources, and the executable as a process."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from detector_process import as_arguments, environment
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.image_encoding import encoded
from yolov5_lifecycle.images import Order, Picture
from yolov5_lifecycle.picture_source import SourceError, open_source
from yolov5_lifecycle.raw_image import decode_raw
from yolov5_lifecycle.ros.camera_settings import CameraSettings
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.messages import picture
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.ros.sighting import Sighting, stamp_ns
from yolov5_lifecycle.scene import CLASS_NAMES, Scene

GREYS = (10, 90, 170, 250)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Evenly grey pictures, 24 x 32, whose names sort in the order of GREYS, and a file that is none."""
    for index, grey in enumerate(GREYS):
        assert cv2.imwrite(str(tmp_path / f"{index}.png"), np.full((24, 32, 3), grey, np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    return tmp_path


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """The same pictures as a video."""
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (32, 24))
    assert writer.isOpened()
    for grey in GREYS:
        writer.write(np.full((24, 32, 3), grey, np.uint8))
    writer.release()
    return path


def greys(source: Path, count: int, *, loop: bool) -> list[int]:
    """The brightness of the first pictures, to the nearest of GREYS."""
    frames = islice(open_source(str(source), loop=loop), count)
    return [min(GREYS, key=lambda grey: abs(grey - frame.picture.pixels.mean())) for frame in frames]


# Sources


def test_the_scene_comes_with_its_truth() -> None:
    frames = list(islice(open_source("synthetic", seed=4, size_hw=(120, 160)), 3))
    for index, frame in enumerate(frames):
        pixels, truth = Scene(4, (120, 160)).frame(index)
        assert (frame.picture.pixels == pixels).all()
        assert frame.truth is not None
        assert (frame.truth.boxes_xyxy == truth.boxes_xyxy).all()


@pytest.mark.parametrize("source", ["folder", "video"])
def test_files_come_in_order_and_end(source: str, request: pytest.FixtureRequest) -> None:
    assert greys(request.getfixturevalue(source), 10, loop=False) == [*GREYS]


@pytest.mark.parametrize("source", ["folder", "video"])
def test_files_begin_anew_with_loop(source: str, request: pytest.FixtureRequest) -> None:
    assert greys(request.getfixturevalue(source), 10, loop=True) == [*GREYS, *GREYS, *GREYS[:2]]


def test_one_picture_is_a_source(folder: Path) -> None:
    assert greys(folder / "2.png", 3, loop=True) == [170, 170, 170]
    assert greys(folder / "2.png", 3, loop=False) == [170]


@pytest.mark.parametrize("source", ["folder", "video"])
def test_pictures_of_files_get_the_size_that_was_asked_for(
    source: str, request: pytest.FixtureRequest
) -> None:
    path = request.getfixturevalue(source)
    frames = [next(open_source(str(path), size_hw=size_hw)) for size_hw in (None, (12, 40))]
    assert [frame.picture.size_hw for frame in frames] == [(24, 32), (12, 40)]


def test_a_source_that_is_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"no/such\.mp4' is neither 'synthetic'"):
        open_source(str(tmp_path / "no/such.mp4"))


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="has no pictures"):
        open_source(str(tmp_path))


@pytest.mark.parametrize("name", ["text.mp4", "text"])
def test_a_file_that_is_no_video_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("this is no video")
    with pytest.raises(SourceError, match="neither as a picture nor as a video"):
        open_source(str(tmp_path / name))


def test_a_device_that_is_not_there_is_refused() -> None:
    with pytest.raises(SourceError, match="Device 4711 cannot be opened"):
        open_source("4711")


def test_a_damaged_picture_is_named_when_its_turn_comes(folder: Path) -> None:
    (folder / "1.png").write_bytes(b"damaged")
    frames = open_source(str(folder))
    next(frames)
    with pytest.raises(SourceError, match=r"1\.png cannot be read"):
        next(frames)


def test_a_video_that_goes_away_ends_with_the_reason(video: Path) -> None:
    frames = open_source(str(video), loop=True)
    assert len(list(islice(frames, len(GREYS)))) == len(GREYS)
    video.unlink()
    with pytest.raises(SourceError, match="can be read no longer"):
        next(frames)


@pytest.mark.parametrize("encoding", get_args(CameraSettings.model_fields["encoding"].annotation))
@pytest.mark.parametrize("order", ["rgb", "bgr"])
def test_what_is_encoded_is_decoded_to_the_same_colours(order: Order, encoding: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    if encoding == "mono8":
        pixels[...] = pixels[..., :1]
    buffer = encoded(Picture(pixels, order), encoding)
    height, width, channels = buffer.shape
    decoded = decode_raw(
        buffer.tobytes(),
        encoding=encoding,
        height=height,
        width=width,
        step=width * channels,
        is_bigendian=False,
    )
    same = decoded.pixels if decoded.order == order else decoded.pixels[..., ::-1]
    assert (same == pixels).all()


# The executable


@contextmanager
def camera_process(domain: int, *arguments: str) -> Iterator[ChildProcess]:
    command = [entry_point("camera"), *arguments]
    with ChildProcess("camera", command, environment(domain)) as process:
        yield process


@pytest.fixture
def observer(ros_domain: int) -> Iterator[Observer]:
    with closing(Observer("client", domain=ros_domain)) as observer:
        yield observer


def test_the_scene_is_published_with_its_truth_until_a_signal(observer: Observer, ros_domain: int) -> None:
    images: dict[int, Image] = {}
    truths: dict[int, Sighting] = {}

    def take_image(message: Image) -> None:
        images[stamp_ns(message.header)] = message

    def take_truth(message: Detection2DArray) -> None:
        truths[stamp_ns(message.header)] = Sighting.now(message)

    observer.create_subscription(Image, "/image_raw", take_image, QoSProfile(depth=10))
    observer.create_subscription(Detection2DArray, "/camera/truth", take_truth, QoSProfile(depth=10))
    parameters = {"width": 160, "height": 120, "seed": 4, "encoding": "bgr8", "frame_id": "lens"}
    with camera_process(ros_domain, "--ros-args", *as_arguments(parameters)) as camera:
        observer.wait_for(lambda: len(images.keys() & truths.keys()) >= 5, "images and their truths")
        assert camera.stop(signal.SIGTERM) == 0
    scene = Scene(4, (120, 160))
    index_of = {scene.frame(index)[0].tobytes(): index for index in range(1000)}
    stamps = sorted(images.keys() & truths.keys())
    indices = [index_of[picture(images[stamp]).pixels[..., ::-1].tobytes()] for stamp in stamps]
    assert indices == sorted(set(indices))
    for stamp, index in zip(stamps, indices, strict=True):
        image, told, truth = images[stamp], truths[stamp], scene.frame(index)[1]
        assert (image.encoding, image.step, image.header.frame_id) == ("bgr8", 480, "lens")
        assert told.class_names == tuple(CLASS_NAMES[class_id] for class_id in truth.class_ids)
        assert np.allclose(told.boxes_xyxy, truth.boxes_xyxy, atol=1e-3)


def test_without_loop_the_process_ends_with_the_files(
    observer: Observer, ros_domain: int, video: Path
) -> None:
    arguments = as_arguments({"source": str(video), "loop": "false", "rate": 100})
    with camera_process(ros_domain, "--ros-args", *arguments) as camera:
        assert camera.wait(20.0) == 0
    assert camera.output == ""


def test_a_source_that_fails_later_ends_the_process_with_the_reason(ros_domain: int, folder: Path) -> None:
    (folder / "3.png").write_bytes(b"damaged")
    arguments = as_arguments({"source": str(folder), "rate": 100})
    with camera_process(ros_domain, "--ros-args", *arguments) as camera:
        assert camera.wait(20.0) == 1
    assert "3.png cannot be read" in camera.output


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        pytest.param({"source": "/nowhere.mp4"}, ["'/nowhere.mp4' is neither"], id="source"),
        pytest.param({"rate": "0.0", "seed": "-1"}, ["rate: 0.0", "seed: -1"], id="ranges"),
        pytest.param({"encoding": "yuv"}, ["encoding: 'yuv'", "'bgr8'"], id="choice"),
        pytest.param({"rate": "fast"}, ["rate: 'fast'"], id="type"),
        pytest.param({"width": 640}, ["width and height go together"], id="one side"),
        pytest.param({"width": 20, "height": 20}, ["at least 64 pixels"], id="too small"),
        pytest.param({"sorce": "0"}, ["sorce", "Did you mean 'source'?"], id="unknown name"),
    ],
)
def test_a_wrong_parameter_is_explained(
    ros_domain: int, parameters: dict[str, object], told: list[str]
) -> None:
    with camera_process(ros_domain, "--ros-args", *as_arguments(parameters)) as camera:
        assert camera.wait(20.0) == 2
    assert all(word in camera.output for word in told), camera.output
    assert "Traceback" not in camera.output


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        pytest.param(["--help"], 0, "rate ", id="help"),
        pytest.param(["--source", "0"], 2, "not understood: --source 0", id="unknown flag"),
        pytest.param(
            ["--ros-args", "--params-file", "/nowhere.yaml"], 2, "/nowhere.yaml", id="parameter file"
        ),
    ],
)
def test_the_command_line_is_explained(ros_domain: int, words: list[str], code: int, told: str) -> None:
    with camera_process(ros_domain, *words) as camera:
        assert camera.wait(20.0) == code
    assert told in camera.output
