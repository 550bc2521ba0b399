"""What the camera publishes, the executable as a process."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from support.camera_info_file import camera_info_url
from support.detector_process import Sighting, as_arguments, camera_process
from support.grey_images import GREYS, grey_folder, grey_video, nearest_grey
from support.lone_node import lone_node
from vision_msgs.msg import Detection2DArray, Detection3DArray

from yolov5_lifecycle.images.image import ChannelOrder, ColourImage
from yolov5_lifecycle.ros.camera import outputs
from yolov5_lifecycle.ros.camera.outputs import CameraOutputs, jpeg_message, raw_message
from yolov5_lifecycle.ros.camera.settings import CameraSettings
from yolov5_lifecycle.ros.messages import image_of_message, stamp_ns
from yolov5_lifecycle.ros.observer import PATIENCE_S, Observer
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene, label_image
from yolov5_lifecycle.sources.scene_depth import SceneDepth
from yolov5_lifecycle.sources.source import open_source
from yolov5_lifecycle.spatial.camera_model import intrinsics_of_message
from yolov5_lifecycle.spatial.depth_image import depth_image_of_message

RELIABLE = QoSProfile(depth=10)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.mark.parametrize("encoding", get_args(CameraSettings.model_fields["encoding"].annotation))
@pytest.mark.parametrize("channel_order", ["rgb", "bgr"])
def test_what_is_encoded_is_decoded_to_the_same_colours(channel_order: ChannelOrder, encoding: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    if encoding == "mono8":
        pixels[...] = pixels[..., :1]
    decoded = image_of_message(raw_message(ColourImage(pixels, channel_order), encoding, Header()))
    same = decoded.pixels if decoded.channel_order == channel_order else decoded.pixels[..., ::-1]
    assert (same == pixels).all()


@pytest.mark.parametrize(
    ("encoding", "format_"),
    [
        ("rgb8", "rgb8; jpeg compressed bgr8"),
        ("mono8", "mono8; jpeg compressed "),
    ],
)
def test_a_jpeg_has_the_colours_and_names_the_encoding(encoding: str, format_: str) -> None:
    rgb = (90, 90, 90) if encoding == "mono8" else (200, 90, 20)
    message = jpeg_message(ColourImage(np.full((16, 16, 3), rgb, np.uint8), "rgb"), encoding, Header())
    assert np.allclose(image_of_message(message).pixels, rgb[::-1], atol=3)
    assert message.format == format_


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


def together(*received: dict[int, Any]) -> list[int]:
    """Stamps of which all of `received` have a message."""
    return sorted(set.intersection(*map(set, received)))


def test_a_video_played_once_reaches_a_subscriber_completely_and_nothing_more_is_known_of_it(
    observer: Observer, ros_domain: int, tmp_path: Path
) -> None:
    images, published = list[Image](), set[str]()
    masks = collected(observer, Image, "/camera/ground_truth_masks")
    infos = collected(observer, CameraInfo, "/camera_info")
    observer.create_subscription(Image, "/image_raw", images.append, RELIABLE)  # for which the camera waits

    def is_complete() -> bool:
        published.update(name for name, _ in observer.get_topic_names_and_types())
        return len(images) == len(infos) == len(GREYS)

    video = grey_video(tmp_path / "video.avi")
    arguments = as_arguments({"source": str(video), "loop": "false", "rate": 1000})
    with camera_process(ros_domain, "--ros-args", *arguments) as camera:
        observer.wait_for(is_complete, "every image")
        assert camera.wait(PATIENCE_S) == 0
    assert [nearest_grey(image_of_message(image)) for image in images] == [*GREYS]
    assert "waiting for a subscriber to /image_raw\n" in camera.output
    assert "publishing 32 x 24 (rgb8) at 1000 images per second on /image_raw\n" in camera.output
    assert not masks
    assert "/camera/truth" in published
    assert not {name for name in published if "depth" in name or "3d" in name}
    assert {tuple(info.k) for info in infos.values()} == {(0.0,) * 9}, "not calibrated"


TOPICS = {
    "/front/image_raw": Image,
    "/front/image_raw/compressed": CompressedImage,
    "/front/camera_info": CameraInfo,
    "/front/depth/image_raw": Image,
    "/front/depth/camera_info": CameraInfo,
    "/camera/truth": Detection2DArray,
    "/camera/ground_truth_masks": Image,
    "/camera/ground_truth_3d": Detection3DArray,
}


def ids_of(message: Detection2DArray | Detection3DArray) -> list[str]:
    return [detection.id for detection in message.detections]


@pytest.mark.end_to_end
def test_the_scene_is_published_with_all_that_is_known_of_it_until_a_signal(
    observer: Observer, ros_domain: int
) -> None:
    """Each message has the header of its image, on topics that follow the remapping."""
    received = [collected(observer, kind, topic, BEST_EFFORT) for topic, kind in TOPICS.items()]
    parameters = {"width": 160, "height": 120, "seed": 4, "encoding": "bgr8", "frame_id": "lens"}
    parameters |= {
        "depth": True,
        "image_transport": "both",
        "qos_overrides./front/image_raw.publisher.reliability": "best_effort",
    }
    words = ["--ros-args", "-r", "image_raw:=/front/image_raw", *as_arguments(parameters)]
    with camera_process(ros_domain, *words) as camera:
        observer.wait_for(lambda: len(together(*received)) >= 3, "messages on every topic")
        (publisher,) = observer.get_publishers_info_by_topic("/front/image_raw")
        assert camera.stop(signal.SIGTERM) == 0
    assert publisher.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    scene = Scene(4, (120, 160))
    space = SceneDepth(4, scene)
    index_of = {scene.frame(index)[0].tobytes(): index for index in range(1000)}
    stamps = together(*received)
    indices = [index_of[image_of_message(received[0][at]).pixels[..., ::-1].tobytes()] for at in stamps]
    assert indices == sorted(set(indices))
    for stamp, index in zip(stamps, indices, strict=True):
        raw, jpeg, info, depth, depth_info, truth, masks, places = (each[stamp] for each in received)
        assert all(each[stamp].header == raw.header for each in received)
        assert (raw.header.frame_id, depth.encoding, masks.encoding) == ("lens", "16UC1", "16UC1")
        assert (raw.encoding, raw.step) == ("bgr8", 480)
        assert jpeg == jpeg_message(image_of_message(raw), "bgr8", raw.header)
        told, known = Sighting.of(truth), scene.frame(index)[1]
        assert told.class_names == tuple(CLASS_NAMES[class_id] for class_id in known.class_ids)
        assert np.allclose(told.boxes_xyxy, known.boxes_xyxy, atol=1e-3)
        assert info == depth_info
        intrinsics = intrinsics_of_message(info, is_rectified=False)
        assert (intrinsics.size_hw, intrinsics.fx, intrinsics.distortion) == ((120, 160), 160, None)
        expected = space.frame(index)
        np.testing.assert_array_equal(depth_image_of_message(depth).values, expected.depth_mm)
        assert ids_of(places) == ids_of(truth) == [str(number) for number in range(1, 7)]
        boxes = [detection.bbox for detection in places.detections]
        centres = [(box.center.position.x, box.center.position.y, box.center.position.z) for box in boxes]
        np.testing.assert_allclose(centres, expected.centres_xyz_m)
        np.testing.assert_allclose([(b.size.x, b.size.y, b.size.z) for b in boxes], expected.sizes_xyz_m)
        labels = np.frombuffer(bytes(masks.data), "<u2").reshape(masks.height, masks.width)
        outlines = [shape.outline() for shape in scene.shapes(index)]
        np.testing.assert_array_equal(labels, label_image(outlines, (120, 160)))


def test_what_nobody_subscribes_to_is_not_encoded(
    observer: Observer, ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(outputs, "encode_jpeg")
    with lone_node("camera") as node:
        camera = CameraOutputs(node, CameraSettings(image_transport="both"))
        frame = next(open_source("synthetic").frames)
        raws = collected(observer, Image, "/image_raw")

        def is_received() -> bool:
            camera.publish(frame)
            return bool(raws)

        observer.wait_for(is_received, "an image")


def first_info(observer: Observer) -> CameraInfo:
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    infos = collected(observer, CameraInfo, "/camera_info", latched)
    observer.wait_for(lambda: bool(infos), "the camera's info")
    return next(iter(infos.values()))


@pytest.mark.long
def test_camera_info_is_kept_for_late_subscribers(
    observer: Observer, ros_domain: int, tmp_path: Path
) -> None:
    folder = grey_folder(tmp_path)
    once_in_a_thousand_seconds = {"source": str(folder / "8.png"), "rate": 0.001}
    calibrated = {"camera_info_url": camera_info_url(folder, 32, 24), "frame_id": "lens"}
    with camera_process(ros_domain, "--ros-args", *as_arguments(once_in_a_thousand_seconds | calibrated)):
        info = first_info(observer)
        assert info == first_info(observer)
    assert (info.width, info.height, info.header.frame_id) == (32, 24, "lens")
    assert (info.distortion_model, list(info.d)) == ("plumb_bob", [-0.3615, 0.1661, 4.8e-05, 1e-05, 0])
    assert (info.k[4], info.r[8], info.p[10]) == (437.34, 1, 1)
