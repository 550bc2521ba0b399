"""Images worth a label are kept by the real node while it detects, with what it published of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import CompressedImage
from std_srvs.srv import Trigger
from support.candidates import frames_of
from support.detector_process import WEIGHTS, scene_image
from support.served_node import ServedNode
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.collecting.collected_files import CollectedFrame
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota
from yolov5_lifecycle.detection.prepared_model import prepare_model
from yolov5_lifecycle.evaluation.ground_truth import Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_yolo_folder
from yolov5_lifecycle.ros.messages import image_of_message, jpeg_of_message

EVERYTHING = ("collect:=true", "collect_min_free_mb:=0")


def served_with(folder: Path | None, *parameters: str) -> ServedNode:
    where = (f"collect_dir:={folder}",) if folder else ()
    words = (f"weights:={WEIGHTS}", "device:=cpu", "runtime:=torch", "image_size:=320", *where, *parameters)
    return ServedNode(prepare_model, parameters=words)


def wait_for_kept(served: ServedNode, folder: Path, count: int) -> list[CollectedFrame]:
    served.wait_for(lambda: len(frames_of(folder)) >= count, f"{count} kept images")
    return frames_of(folder)


def ask(served: ServedNode) -> tuple[bool, str]:
    response = served.call("collect", Trigger.Request())
    return response.success, response.message


def test_a_kept_image_has_the_detections_that_were_published(tmp_path: Path) -> None:
    with served_with(tmp_path, *EVERYTHING) as served:
        served.bring_to("active")
        message = scene_image()
        message.header.frame_id, message.header.stamp.sec = "optical", 7
        served.publish(message)
        served.wait_for(lambda: len(served.detections) == 1, "detections")
        (frame,) = wait_for_kept(served, tmp_path, 1)
    published = served.detections[0]
    assert (frame.frame_id, frame.sec, frame.camera) == ("optical", 7, "")
    assert [each.class_name for each in frame.objects] == [
        each.results[0].hypothesis.class_id for each in published.detections
    ]
    assert [each.score for each in frame.objects] == pytest.approx(
        [each.results[0].hypothesis.score for each in published.detections], abs=1e-6
    )
    assert len(frame.objects) > 1
    kept = cv2.imread(str(tmp_path / frame.image))
    sent = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)[..., ::-1]
    assert np.abs(kept.astype(int) - sent).mean() < 3
    told: list[str] = []
    data = read_yolo_folder(tmp_path, Problems(told.append))
    assert told == []
    assert len(data.images[0].boxes) == len(frame.objects)
    folder = CollectedFolder(tmp_path, Quota(max_bytes=1 << 30, min_free_bytes=0))  # which the node has freed
    assert len(folder) == 1
    folder.close()


def test_detections_are_the_same_with_and_without_collecting(tmp_path: Path) -> None:
    uncertain = "confidence_threshold:=0.85"  # lower scores are found for collecting, too
    with served_with(tmp_path, *EVERYTHING, uncertain) as served:
        served.bring_to("active")
        for tracker in ("none", "bytetrack"):
            served.detections.clear()
            for collect in (True, False):
                assert served.set(collect=collect, tracker=tracker) == (True, "")
                served.publish(scene_image())
                served.wait_for(lambda: len(served.detections) == 2 - collect, "detections")  # noqa: B023
            one, other = served.detections
            assert len(one.detections) > 1
            # More cells are computed with a lower threshold, and rounded in other places.
            np.testing.assert_allclose(numbers(one), numbers(other), rtol=1e-5)


def numbers(found: Detection2DArray) -> list[tuple[float, ...]]:
    """Score, centre and size of each detection."""
    return [
        (
            each.results[0].hypothesis.score,
            each.bbox.center.position.x,
            each.bbox.center.position.y,
            each.bbox.size_x,
            each.bbox.size_y,
        )
        for each in found.detections
    ]


def test_collecting_needs_a_folder_that_the_start_names(tmp_path: Path) -> None:
    with served_with(None) as served:
        served.bring_to("active")
        assert "Restart the node with collect_dir" in served.refusal(collect=True)
        assert ask(served) == (False, "there is no folder: restart the node with collect_dir set to one")
        assert served.refusal(collect_dir=str(tmp_path)).startswith("collect_dir: read-only")


def test_an_image_is_kept_on_request_and_without_any_subscriber(tmp_path: Path) -> None:
    with served_with(tmp_path, "collect_min_free_mb:=0") as served:
        served.bring_to("active")
        assert ask(served) == (False, "no camera collects: activate the node, and set collect to true")
        assert served.set(collect=True, collect_reasons=[]) == (True, "")
        for number in range(3):
            served.publish(scene_image())
            served.wait_for(lambda: len(served.detections) == number + 1, "detections")  # noqa: B023
        assert ask(served) == (True, "the next image is kept")
        served.publish(scene_image())
        (frame,) = wait_for_kept(served, tmp_path, 1)
        assert frame.reasons == {"requested": "~/collect"}
        served.wait_for(lambda: served.values()["images collected"] == "1", "the count")
        served.ignore_detections()
        assert ask(served)[0]
        served.publish(scene_image(5))
        wait_for_kept(served, tmp_path, 2)
        assert served.set(collect=False) == (True, "")
        assert not ask(served)[0]
        served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")


def test_a_folder_that_cannot_be_used_is_told_and_detections_go_on(tmp_path: Path) -> None:
    missing = tmp_path / "stick" / "collected"
    with served_with(missing, *EVERYTHING) as served:
        served.bring_to("active")
        served.publish(scene_image())
        served.wait_for(lambda: len(served.detections) == 1, "detections")

        def is_told() -> bool:
            status = served.status()
            return bool(status.level == DiagnosticStatus.WARN and "no images are collected" in status.message)

        served.wait_for(is_told, "the warning")
        assert str(missing) in served.status().message
        done, message = ask(served)
        assert not done
        assert str(missing) in message
        served.publish(scene_image())
        served.wait_for(lambda: len(served.detections) == 2, "detections")
        assert served.state() == "active"


@pytest.mark.parametrize(
    ("pixels", "format_text", "exif", "is_kept"),
    [
        pytest.param(".jpg", "rgb8; jpeg compressed bgr8", b"", True, id="JPEG"),
        pytest.param(".png", "rgb8; png compressed bgr8", b"", False, id="PNG"),
        pytest.param(".jpg", "rgb8; jpeg compressed rgb8", b"", False, id="red and blue exchanged"),
        pytest.param(".jpg", "jpeg", b"\xff\xe1\x00\x10Exif\0\0" + b"\0" * 8, False, id="rotated"),
    ],
)
def test_a_jpeg_message_is_kept_as_it_is_if_every_reader_sees_the_same(
    pixels: str, format_text: str, exif: bytes, is_kept: bool
) -> None:
    data = cv2.imencode(pixels, np.full((8, 8, 3), 99, np.uint8))[1].tobytes()
    message = CompressedImage(format=format_text, data=data[:2] + exif + data[2:])
    jpeg = jpeg_of_message(message, image_of_message(message))
    assert (jpeg is not None) == is_kept
    assert jpeg is None or jpeg.tobytes() == data
