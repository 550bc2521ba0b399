"""The camera: its sources, and the executable as a process."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from support.calibration_file import FILE as CALIBRATION_FILE
from support.colcon_workspace import REPOSITORY
from support.damaged_pictures import claiming_too_much
from support.detector_process import PARAMETERS, SCENE, as_arguments, detector_process, environment
from support.hostile_pictures import HOSTILE_JPEGS
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.images.encodings import decode_raw, encoded
from yolov5_lifecycle.images.image import Order, Picture
from yolov5_lifecycle.ros.camera.outputs import CameraOutputs
from yolov5_lifecycle.ros.camera.settings import CameraSettings
from yolov5_lifecycle.ros.camera.transport import IMAGE_FORMS, ImageForm, jpeg_message
from yolov5_lifecycle.ros.demo.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.demo.ground_truth import Sighting, stamp_ns
from yolov5_lifecycle.ros.demo.observer import Observer
from yolov5_lifecycle.ros.messages import picture
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene
from yolov5_lifecycle.sources.source import open_source
from yolov5_lifecycle.sources.source_error import SourceError

README = REPOSITORY / "README.md"
CAMERA_PAGE = REPOSITORY / "docs" / "camera.md"
GREYS = (10, 90, 170, 250)
END_S = 60.0
RELIABLE = QoSProfile(depth=10)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
RAW_QOS = "qos_overrides./image_raw.publisher"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Evenly grey pictures, 24 x 32, whose numbers have the order of GREYS, and a file that is none."""
    for number, grey in enumerate(GREYS, start=8):
        assert cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((24, 32, 3), grey, np.uint8))
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
    frames = islice(open_source(str(source), loop=loop).frames, count)
    return [nearest_grey(frame.picture) for frame in frames]


def nearest_grey(picture: Picture) -> int:
    return min(GREYS, key=lambda grey: abs(grey - picture.pixels.mean()))


# Sources


def test_the_scene_comes_with_its_truth() -> None:
    frames = list(islice(open_source("synthetic", seed=4, size_hw=(120, 160)).frames, 3))
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
    assert greys(folder / "10.png", 3, loop=True) == [170, 170, 170]
    assert greys(folder / "10.png", 3, loop=False) == [170]


@pytest.mark.parametrize("source", ["folder", "video"])
def test_pictures_of_files_get_the_size_that_was_asked_for(
    source: str, request: pytest.FixtureRequest
) -> None:
    path = request.getfixturevalue(source)
    frames = [next(open_source(str(path), size_hw=size_hw).frames) for size_hw in (None, (12, 40))]
    assert [frame.picture.size_hw for frame in frames] == [(24, 32), (12, 40)]


@pytest.mark.parametrize(("source", "rate_hz"), [("video", 10.0), ("folder", 30.0)])
def test_a_video_has_its_own_rate_and_pictures_a_usual_one(
    source: str, rate_hz: float, request: pytest.FixtureRequest
) -> None:
    assert open_source(str(request.getfixturevalue(source))).rate_hz == pytest.approx(rate_hz)


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


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("4711", "Device 4711 cannot be opened"),
        ("/dev/video4711", "There is no device /dev/video4711. There "),
        ("/dev/zero", "/dev/zero is a device, but no camera. There "),
        ("x" * 5000, "is neither 'synthetic'"),
    ],
)
def test_a_device_that_is_not_there_is_refused(source: str, told: str) -> None:
    with pytest.raises(SourceError, match=told):
        open_source(source)


@pytest.mark.parametrize("source", ["9" * 10, "9" * 5000], ids=len)
def test_a_number_that_no_device_has_is_refused(source: str) -> None:
    with pytest.raises(SourceError, match="nor the number of a device"):
        open_source(source)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        pytest.param(b"damaged", "9.png cannot be read", id="no picture"),
        pytest.param(
            claiming_too_much(), "9.png cannot be read.* OpenCV refuses the image: ", id="too large a claim"
        ),
        pytest.param(
            HOSTILE_JPEGS["a large frame behind TEM"][0],
            "9.png cannot be read.* found marker FF01",
            id="a large frame in disguise",
        ),
        pytest.param(b"", "9.png cannot be read", id="nothing"),
    ],
)
def test_a_damaged_picture_of_a_folder_is_skipped_and_reported_once(
    folder: Path, content: bytes, told: str
) -> None:
    (folder / "9.png").write_bytes(content)
    reports: list[str] = []
    frames = islice(open_source(str(folder), report=reports.append).frames, 9)
    assert [nearest_grey(frame.picture) for frame in frames] == [grey for grey in GREYS if grey != 90] * 3
    assert len(reports) == 2
    assert re.search(f"skipped: {re.escape(str(folder))}/{told}", reports[0])
    assert reports[1] == "1 of 4 pictures were skipped."


@pytest.mark.parametrize("loop", [False, True])
def test_a_folder_without_a_readable_picture_ends_with_the_reason(folder: Path, loop: bool) -> None:
    for path in folder.glob("*.png"):
        path.write_bytes(b"damaged")
    with pytest.raises(SourceError, match="None of the 4 pictures can be read"):
        list(open_source(str(folder), loop=loop).frames)


def test_of_many_damaged_pictures_only_the_first_are_named(folder: Path) -> None:
    for number in range(20, 40):
        (folder / f"{number}.png").write_bytes(b"damaged")
    reports: list[str] = []
    assert len(list(open_source(str(folder), loop=False, report=reports.append).frames)) == len(GREYS)
    assert reports[9].endswith("Further ones are only counted.")
    assert reports[10:] == ["20 of 24 pictures were skipped."]


def test_a_damaged_picture_alone_is_refused(folder: Path) -> None:
    (folder / "9.png").write_bytes(b"damaged")
    with pytest.raises(SourceError, match=r"9\.png cannot be read as a picture"):
        next(open_source(str(folder / "9.png")).frames)


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir], ids=["pipe", "folder"])
def test_what_is_called_like_a_picture_and_is_none_is_skipped(
    folder: Path, make: Callable[[Path], object]
) -> None:
    make(folder / "7.png")
    reports: list[str] = []
    assert len(list(open_source(str(folder), loop=False, report=reports.append).frames)) == len(GREYS)
    assert "7.png is not a regular file" in reports[0]


def test_a_pipe_among_the_pictures_is_not_waited_for(folder: Path) -> None:
    (folder / "9.png").unlink()
    os.mkfifo(folder / "9.png")
    reports: list[str] = []
    assert len(list(islice(open_source(str(folder), report=reports.append).frames, 3))) == 3
    assert "9.png is not a regular file" in reports[0]


def test_a_video_that_goes_away_ends_with_the_reason(video: Path) -> None:
    frames = open_source(str(video), loop=True).frames
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


@pytest.mark.parametrize(
    ("encoding", "format_"),
    [
        ("rgb8", "rgb8; jpeg compressed bgr8"),
        ("bgra8", "bgra8; jpeg compressed bgr8"),
        ("mono8", "mono8; jpeg compressed "),
    ],
)
def test_a_jpeg_has_the_colours_and_tells_the_encoding(encoding: str, format_: str) -> None:
    rgb = (90, 90, 90) if encoding == "mono8" else (200, 90, 20)
    message = jpeg_message(Picture(np.full((16, 16, 3), rgb, np.uint8), "rgb"), encoding, Header())
    assert np.allclose(picture(message).pixels, rgb[::-1], atol=3)
    assert message.format == format_


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


def collected(
    observer: Observer, message_type: type, topic: str, qos: QoSProfile = RELIABLE
) -> dict[int, Any]:
    """What comes on `topic` from now on, by its stamp."""
    messages: dict[int, Any] = {}

    def take(message: Any) -> None:
        messages[stamp_ns(message.header)] = message

    observer.create_subscription(message_type, topic, take, qos)
    return messages


def test_the_scene_is_published_with_its_truth_until_a_signal(observer: Observer, ros_domain: int) -> None:
    images = collected(observer, Image, "/image_raw")
    unreliable = collected(observer, Image, "/image_raw", BEST_EFFORT)
    truths = collected(observer, Detection2DArray, "/camera/truth")
    parameters = {"width": 160, "height": 120, "seed": 4, "encoding": "bgr8", "frame_id": "lens"}
    with camera_process(ros_domain, "--ros-args", *as_arguments(parameters)) as camera:
        observer.wait_for(
            lambda: len(images.keys() & truths.keys()) >= 5 and bool(unreliable), "images and their truths"
        )
        assert camera.stop(signal.SIGTERM, timeout_s=END_S) == 0
    scene = Scene(4, (120, 160))
    index_of = {scene.frame(index)[0].tobytes(): index for index in range(1000)}
    stamps = sorted(images.keys() & truths.keys())
    indices = [index_of[picture(images[stamp]).pixels[..., ::-1].tobytes()] for stamp in stamps]
    assert indices == sorted(set(indices))
    for stamp, index in zip(stamps, indices, strict=True):
        image, told, truth = images[stamp], Sighting.now(truths[stamp]), scene.frame(index)[1]
        assert (image.encoding, image.step, image.header.frame_id) == ("bgr8", 480, "lens")
        assert told.class_names == tuple(CLASS_NAMES[class_id] for class_id in truth.class_ids)
        assert np.allclose(told.boxes_xyxy, truth.boxes_xyxy, atol=1e-3)


def test_what_is_played_once_reaches_whoever_listens_as_a_whole(
    observer: Observer, ros_domain: int, video: Path
) -> None:
    images: list[Image] = []
    observer.create_subscription(Image, "/image_raw", images.append, RELIABLE)
    arguments = as_arguments({"source": str(video), "loop": "false", "rate": 1000})
    with camera_process(ros_domain, "--ros-args", *arguments) as camera:
        observer.wait_for(lambda: len(images) == len(GREYS), "every picture")
        assert camera.wait(END_S) == 0
    assert [nearest_grey(picture(image)) for image in images] == [*GREYS]
    assert "waiting for a subscriber to /image_raw\n" in camera.output
    assert "publishing 32 x 24 (rgb8) at 1000 images per second on /image_raw\n" in camera.output


def test_every_transport_sends_the_same_pictures_where_the_images_are_led_to(
    observer: Observer, ros_domain: int
) -> None:
    raws = collected(observer, Image, "/front/image_raw")
    jpegs = collected(observer, CompressedImage, "/front/image_raw/compressed")
    infos = collected(observer, CameraInfo, "/front/camera_info")
    parameters = {"image_transport": "both", "width": 160, "height": 120, "frame_id": "lens"}
    arguments = ["-r", "image_raw:=/front/image_raw", *as_arguments(parameters)]
    with camera_process(ros_domain, "--ros-args", *arguments):
        observer.wait_for(lambda: bool(raws.keys() & jpegs.keys() & infos.keys()), "one picture everywhere")
    stamp = min(raws.keys() & jpegs.keys() & infos.keys())
    raw, jpeg, info = raws[stamp], jpegs[stamp], infos[stamp]
    assert raw.header == jpeg.header == info.header
    assert (info.header.frame_id, info.width, info.height, info.k[0]) == ("lens", 160, 120, 0.0)
    assert jpeg == jpeg_message(picture(raw), "rgb8", raw.header)


def test_compressed_images_come_alone_and_with_the_quality_of_service_that_was_asked_for(
    observer: Observer, ros_domain: int
) -> None:
    jpegs = collected(observer, CompressedImage, "/image_raw/compressed", BEST_EFFORT)
    parameters = {"image_transport": "compressed", "encoding": "mono8", "width": 160, "height": 120}
    override = {"qos_overrides./image_raw/compressed.publisher.reliability": "best_effort"}

    def offers() -> list[ReliabilityPolicy]:
        publishers = observer.get_publishers_info_by_topic("/image_raw/compressed")
        return [publisher.qos_profile.reliability for publisher in publishers]

    with camera_process(ros_domain, "--ros-args", *as_arguments(parameters | override)):
        observer.wait_for(lambda: bool(jpegs and offers()), "a picture and its publisher")
        assert offers() == [ReliabilityPolicy.BEST_EFFORT]
        assert observer.count_publishers("/image_raw") == 0
    assert {jpeg.format for jpeg in jpegs.values()} == {"mono8; jpeg compressed "}


def noting(form: ImageForm, made: list[str]) -> ImageForm:
    """`form`, telling `made` its suffix whenever it makes a message."""

    def message(*arguments: Any) -> Any:
        made.append(form.suffix)
        return form.message(*arguments)

    return form._replace(message=message)


def test_a_form_to_which_nobody_listens_is_not_made(observer: Observer, ros_domain: int) -> None:
    made: list[str] = []
    forms = {transport: [noting(form, made) for form in forms] for transport, forms in IMAGE_FORMS.items()}
    context = rclpy.Context()
    rclpy.init(context=context, args=[])
    node = rclpy.create_node("camera", context=context)
    outputs = CameraOutputs(node, CameraSettings(image_transport="both"), forms=forms)
    frame = next(open_source("synthetic").frames)
    outputs.publish(frame)
    assert made == []
    raws = collected(observer, Image, "/image_raw")

    def is_received() -> bool:
        outputs.publish(frame)
        return bool(raws)

    observer.wait_for(is_received, "an image")
    assert set(made) == {""}
    node.destroy_node()
    rclpy.shutdown(context=context)


def calibration(folder: Path, width: str, height: str) -> str:
    """URL of a calibration for images of this size."""
    path = folder / "lens.yaml"
    path.write_text(CALIBRATION_FILE.replace("640", width, 1).replace("480", height, 1))
    return f"file://{path}"


def first_info(observer: Observer) -> CameraInfo:
    infos: list[CameraInfo] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    observer.create_subscription(CameraInfo, "/camera_info", infos.append, latched)
    observer.wait_for(lambda: bool(infos), "the camera's info")
    return infos[0]


def test_camera_info_is_kept_for_late_subscribers(observer: Observer, ros_domain: int, folder: Path) -> None:
    once_in_a_thousand_seconds = {"source": str(folder / "8.png"), "rate": 0.001}
    calibrated = {"camera_info_url": calibration(folder, "32", "24"), "frame_id": "lens"}
    with camera_process(ros_domain, "--ros-args", *as_arguments(once_in_a_thousand_seconds | calibrated)):
        info = first_info(observer)
        assert info == first_info(observer)
    assert (info.width, info.height, info.header.frame_id) == (32, 24, "lens")
    assert (info.distortion_model, list(info.d)) == ("plumb_bob", [-0.3615, 0.1661, 4.8e-05, 1e-05, 0])
    assert (info.k[4], info.r[8], info.p[10]) == (437.34, 1, 1)


@pytest.fixture
def scene_video(tmp_path: Path) -> Path:
    """A second of the scene that the small model knows."""
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    assert writer.isOpened()
    for index in range(30):
        writer.write(cv2.cvtColor(SCENE.frame(index)[0], cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def readme_commands() -> dict[str, str]:
    """The words behind `camera` and `detector` in the README's section on a video."""
    section = README.read_text().partition("\n## Your video instead of a camera\n")[2].partition("\n## ")[0]
    return dict(re.findall(r"^(camera|detector) (.*)$", section, re.MULTILINE))


def test_the_objects_in_a_video_are_detected_with_the_commands_of_the_readme(scene_video: Path) -> None:
    words = readme_commands()
    of_camera = words["camera"].replace("video.mp4", str(scene_video)).split()
    of_detector = words["detector"].split() + as_arguments(PARAMETERS | {"runtime": "torch"})
    assert of_detector.pop(0) == "--ros-args"
    with detector_process(*of_detector) as detector, camera_process(detector.domain, *of_camera):
        detector.observer.wait_for(
            lambda: any(message.detections for message in detector.detections), "detections of something"
        )


def parameter_rows() -> list[tuple[str, object, str]]:
    section = CAMERA_PAGE.read_text().partition("\n## Parameters\n")[2].partition("\n## ")[0]
    cells = re.findall(r"^\| `(\w+)` \| `(.*?)` \| (.*) \|$", section, re.MULTILINE)
    return [(name, json.loads(default), description) for name, default, description in cells]


def test_the_page_of_the_camera_tells_its_parameters() -> None:
    assert parameter_rows() == [
        (name, field.default, field.description) for name, field in CameraSettings.model_fields.items()
    ]


def test_a_source_that_hangs_does_not_hold_up_the_end(ros_domain: int, tmp_path: Path) -> None:
    hanging = tmp_path / "video.mp4"
    os.mkfifo(hanging)
    with (
        camera_process(ros_domain, "--ros-args", *as_arguments({"source": str(hanging)})) as camera,
        hanging.open("wb"),  # waits until the camera reads
    ):
        assert camera.stop(signal.SIGINT, timeout_s=END_S) == 0


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        pytest.param({"source": "/nowhere.mp4"}, "'/nowhere.mp4' is neither", id="no file"),
        pytest.param({"width": 20, "height": 20}, "at least 64 pixels", id="too small a scene"),
    ],
)
def test_a_source_that_cannot_be_opened_ends_the_process_with_the_reason(
    ros_domain: int, parameters: dict[str, object], told: str
) -> None:
    with camera_process(ros_domain, "--ros-args", *as_arguments(parameters)) as camera:
        assert camera.wait(END_S) == 1
    assert told in camera.output


def test_images_of_another_size_than_the_calibration_end_the_process_with_the_reason(
    ros_domain: int, folder: Path
) -> None:
    arguments = as_arguments({"source": str(folder), "camera_info_url": calibration(folder, "64", "48")})
    with camera_process(ros_domain, "--ros-args", *arguments) as camera:
        assert camera.wait(END_S) == 1
    assert "The images are 32 x 24, but camera_info_url has the calibration for 64 x 48" in camera.output


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        pytest.param({"rate": "-1.0", "seed": "-1"}, ["rate: -1.0", "seed: -1"], id="ranges"),
        pytest.param({"encoding": "yuv"}, ["encoding: 'yuv'", "one of rgb8, bgr8"], id="choice"),
        pytest.param({"rate": "fast"}, ["rate: 'fast'"], id="type"),
        pytest.param({"camera_info_url": "x.yaml"}, ["camera_info_url: ", "file:///PATH"], id="calibration"),
        pytest.param({"width": 640}, ["width and height go together"], id="one side"),
        pytest.param({"use_sim_time": "1"}, ["'use_sim_time'"], id="a parameter of ROS's own"),
        pytest.param({"sorce": "0"}, ["sorce", "Did you mean 'source'?"], id="unknown name"),
        pytest.param(
            {f"{RAW_QOS}.reliability": "maybe"}, ["`reliability`: `maybe`"], id="quality of service"
        ),
        pytest.param({f"{RAW_QOS}.deph": 5}, ["Did you mean", f"{RAW_QOS}.depth"], id="unknown quality"),
    ],
)
def test_a_wrong_parameter_is_explained(
    ros_domain: int, parameters: dict[str, object], told: list[str]
) -> None:
    with camera_process(ros_domain, "--ros-args", *as_arguments(parameters)) as camera:
        assert camera.wait(END_S) == 2
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
        assert camera.wait(END_S) == code
    assert told in camera.output
