"""The installed executables as processes, over the real middleware, with the embedded model."""

from __future__ import annotations

import signal
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rcl_interfaces.msg import Parameter, ParameterValue
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from support.detector_process import (
    NODE,
    PARAMETERS,
    SEED,
    WEIGHTS,
    DetectorProcess,
    as_arguments,
    detector_process,
    environment,
    is_balanced,
    parameter_file,
    scene_image,
    scene_truth,
)
from support.random_model import blank_model
from vision_msgs.msg import Detection2DArray

from benchmark.process_memory import resident_mb
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.images.encodings import ENCODINGS
from yolov5_lifecycle.models.architecture import SIZES
from yolov5_lifecycle.ros.demo.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.demo.ground_truth import Sighting, pairwise_iou, recall, stamp_ns
from yolov5_lifecycle.ros.demo.observer import PATIENCE_S
from yolov5_lifecycle.ros.messages import image_message, picture
from yolov5_lifecycle.runtimes.cache_folder import cache_folder
from yolov5_lifecycle.sources.scene import CLASS_NAMES

STATES = ("unconfigured", "inactive", "active")


@pytest.fixture(scope="module", autouse=True)
def _stay_on_this_machine() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@pytest.fixture(scope="module")
def shared_detector(_stay_on_this_machine: None) -> Iterator[DetectorProcess]:
    with detector_process(*as_arguments(PARAMETERS)) as detector:
        yield detector


@pytest.fixture
def detector(shared_detector: DetectorProcess) -> DetectorProcess:
    """A running process, unconfigured, its parameters as at the start."""
    shared_detector.reset()
    return shared_detector


@pytest.fixture
def active(detector: DetectorProcess) -> DetectorProcess:
    detector.bring_to("active")
    return detector


# The whole way of a frame


def test_a_camera_and_the_detector_find_the_shapes_where_they_are(detector: DetectorProcess) -> None:
    truths: dict[int, Sighting] = {}

    def take_truth(message: Detection2DArray) -> None:
        truths[stamp_ns(message.header)] = Sighting.now(message)

    observer, messages = detector.observer, detector.detections
    subscription = observer.create_subscription(Detection2DArray, "/camera/truth", take_truth, 10)
    parameters = {"width": 320, "height": 240, "seed": SEED, "frame_id": "lens"}
    remap = f"image_raw:={NODE}/image_raw"
    command = [entry_point("camera"), "--ros-args", "-r", remap, *as_arguments(parameters)]
    with ChildProcess("camera", command, environment(detector.domain)) as camera:
        observer.wait_for(lambda: bool(truths), "the camera's truth")
        detector.bring_to("active")
        observer.wait_for(lambda: len(messages) >= 60, "60 messages")
        assert {message.header.frame_id for message in messages} == {"lens"}
        assert recall(map(Sighting.now, messages), truths) > 0.9
        assert detector.transition("deactivate")
        last_ns = stamp_ns(messages[-1].header)
        assert detector.transition("activate")
        observer.wait_for(lambda: stamp_ns(messages[-1].header) > last_ns, "messages once active again")
        assert camera.stop(signal.SIGINT, timeout_s=PATIENCE_S) == 0
    observer.destroy_subscription(subscription)


@pytest.mark.parametrize("padding", [0, 13])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "rgba8", "bgra8"])
def test_every_encoding_is_understood(active: DetectorProcess, encoding: str, padding: int) -> None:
    shown = scene_image(7, encoding="mono8" if encoding == "mono8" else "rgb8")
    plain = image_message(picture(shown).pixels, "rgb8", shown.header)
    expected = Sighting.now(active.detect(plain))
    assert encoding == "mono8" or expected.found_of(scene_truth(7)) >= len(scene_truth(7).scores) - 1
    found = Sighting.now(active.detect(scene_image(7, encoding=encoding, padding=padding)))
    assert found.class_names == expected.class_names
    assert found.scores == pytest.approx(expected.scores, abs=1e-4)
    assert np.allclose(found.boxes_xyxy, expected.boxes_xyxy, atol=0.05)


def interleaved(*planes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.dstack(planes).reshape(len(planes[0]), -1)


GREY_ROWS: dict[str, Callable[[NDArray[np.uint8], NDArray[np.uint8]], NDArray[np.uint8]]] = {
    **dict.fromkeys(
        ("8UC1", "bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"), lambda grey, _: grey
    ),
    "8UC3": lambda grey, _: interleaved(grey, grey, grey),
    **dict.fromkeys(("mono16", "16UC1"), lambda grey, _: interleaved(grey, grey)),
    **dict.fromkeys(("uyvy", "yuv422"), lambda grey, neutral: interleaved(neutral, grey)),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), lambda grey, neutral: interleaved(grey, neutral)),
    **dict.fromkeys(("nv12", "nv21"), lambda grey, neutral: np.vstack((grey, neutral[::2]))),
    "nv24": lambda grey, neutral: np.vstack((grey, neutral, neutral)),
}
"""The rows of a grey picture in the encodings that only cameras send, its chroma neutral."""


@pytest.mark.parametrize("encoding", GREY_ROWS)
def test_every_encoding_of_cameras_is_understood(active: DetectorProcess, encoding: str) -> None:
    image = scene_image(7, encoding="mono8")
    grey = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
    rows = GREY_ROWS[encoding](grey, np.full_like(grey, 128))
    image.encoding, image.step, image.data = encoding, rows.shape[1], array("B", rows.tobytes())
    plain = image_message(picture(image).pixels, "rgb8", scene_image().header)
    found, expected = (Sighting.now(active.detect(each)) for each in (image, plain))
    assert found.class_names == expected.class_names != ()
    assert found.scores == pytest.approx(expected.scores, abs=1e-4)


def test_no_encoding_is_forgotten() -> None:
    assert {*GREY_ROWS, "rgb8", "bgr8", "mono8", "rgba8", "bgra8"} == {*ENCODINGS}


def test_a_picture_without_shapes_gives_an_empty_message(active: DetectorProcess) -> None:
    image = scene_image()
    image.data[:] = type(image.data)("B", bytes([114]) * len(image.data))
    assert active.detect(image).detections == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        pytest.param({"encoding": "32FC1"}, "32FC1", id="encoding"),
        pytest.param({"step": 7}, "step", id="step"),
        pytest.param({"height": 4000}, "bytes", id="height"),
        pytest.param({"width": 0}, "width", id="empty"),
    ],
)
def test_an_unreadable_image_is_counted_and_the_next_one_detected(
    active: DetectorProcess, change: dict[str, object], reason: str
) -> None:
    active.look()
    rejected = int(active.status()["frames rejected"])
    image = scene_image()
    for field, value in change.items():
        setattr(image, field, value)
    active.publish(image)
    status = active.status()
    assert int(status["frames rejected"]) == rejected + 1
    assert reason in status["message"]
    assert len(active.look().scores) > 0


def test_the_annotated_image_has_the_header_of_its_source_and_boxes_drawn(active: DetectorProcess) -> None:
    drawn: list[Image] = []
    topic = f"{NODE}/image"
    subscription = active.observer.create_subscription(Image, topic, drawn.append, QoSProfile(depth=1))
    active.observer.wait_for(lambda: active.observer.count_publishers(topic) == 1, "the publisher of images")
    source = scene_image()
    found = Sighting.now(active.detect(source))
    active.observer.wait_for(lambda: bool(drawn), "an annotated image")
    active.observer.destroy_subscription(subscription)
    assert drawn[0].header == source.header
    changed = (picture(drawn[0]).pixels != picture(source).pixels).any(axis=2)
    for x1, y1, _, y2 in np.rint(found.boxes_xyxy).astype(int):
        left_side = changed[y1 + 3 : y2 - 3, max(x1 - 1, 0) : x1 + 2]
        assert left_side.any(axis=1).mean() > 0.9


def test_labels_reach_a_late_subscriber(active: DetectorProcess) -> None:
    assert active.node.set_parameters(confidence_threshold=0.5) == ""
    labels = active.late_label_info()
    assert [(entry.class_id, entry.class_name) for entry in labels.class_map] == list(enumerate(CLASS_NAMES))
    assert labels.threshold == 0.5


# Parameters while active


def test_a_raised_threshold_is_obeyed_by_the_next_frame(active: DetectorProcess) -> None:
    scores = active.look().scores
    middle = float(np.mean([min(scores), max(scores)]))
    assert active.node.set_parameters(confidence_threshold=middle) == ""
    assert active.look().scores == tuple(score for score in scores if score > middle)


@pytest.mark.parametrize("classes", [["circle", "star"], ["0", "3"]], ids=["names", "indices"])
def test_a_class_filter_is_obeyed_by_the_next_frame(active: DetectorProcess, classes: list[str]) -> None:
    everything = set(active.look().class_names)
    assert everything > {"circle", "star"}
    assert active.node.set_parameters(classes=classes) == ""
    assert set(active.look().class_names) == {"circle", "star"}
    assert active.node.set_parameters(classes=[]) == ""
    assert set(active.look().class_names) == everything


def test_a_limit_on_detections_is_obeyed_by_the_next_frame(active: DetectorProcess) -> None:
    best = active.look()
    assert active.node.set_parameters(max_detections=2) == ""
    assert active.look().scores == best.scores[:2]


def test_agnostic_suppression_is_obeyed_by_the_next_frame(active: DetectorProcess) -> None:
    assert active.node.set_parameters(confidence_threshold=0.0001, iou_threshold=0.0) == ""
    assert _largest_overlap(active.look()) > 0.05
    assert active.node.set_parameters(agnostic_nms=True) == ""
    assert _largest_overlap(active.look()) < 0.01


def _largest_overlap(found: Sighting) -> float:
    ious = pairwise_iou(found.boxes_xyxy, found.boxes_xyxy)
    return float(np.triu(ious, k=1).max(initial=0))


def test_a_class_that_the_model_does_not_have_is_refused_with_a_suggestion(active: DetectorProcess) -> None:
    refusal = active.node.set_parameters(classes=["cirlce"])
    assert "cirlce" in refusal
    assert "Did you mean 'circle'?" in refusal
    assert active.node.parameter("classes") == []
    assert len(active.look().scores) > 0


def test_another_image_size_is_swapped_in_while_active(active: DetectorProcess) -> None:
    assert active.node.set_parameters(image_size=416) == ""
    assert active.look().found_of(scene_truth()) >= len(scene_truth().scores) - 1
    refusal = active.node.set_parameters(image_size=417)
    assert "image_size" in refusal
    assert active.node.parameter("image_size") == 416
    assert active.node.state() == "active"


@pytest.mark.parametrize("state", STATES)
def test_a_value_of_a_type_that_does_not_exist_is_refused(detector: DetectorProcess, state: str) -> None:
    detector.bring_to(state)
    (result,) = detector.set_one_by_one([Parameter(name="iou_threshold", value=ParameterValue(type=42))])
    assert not result.successful
    assert result.reason
    assert detector.node.state() == state


# States


@pytest.mark.parametrize("state", STATES)
def test_diagnostics_tell_the_state_and_the_balance_of_frames(detector: DetectorProcess, state: str) -> None:
    detector.bring_to("active")
    detector.look()
    detector.bring_to(state)
    status = detector.status()
    assert status["state"] == state
    assert is_balanced(status)
    assert int(status["frames detected"]) >= 1


@pytest.mark.parametrize(
    ("state", "refused"),
    [
        ("unconfigured", ("activate", "deactivate", "cleanup")),
        ("inactive", ("configure", "deactivate")),
        ("active", ("configure", "activate", "cleanup")),
    ],
)
def test_a_transition_that_is_not_possible_is_refused(
    detector: DetectorProcess, state: str, refused: tuple[str, ...]
) -> None:
    detector.bring_to(state)
    for label in refused:
        assert not detector.transition(label)
    for transition_id in (0, 10, 99, 255):  # none, a private one, two that do not exist
        assert not detector.transition(transition_id=transition_id)
    assert detector.node.state() == state


def test_missing_weights_are_named_with_the_remedy_and_may_be_given_then(detector: DetectorProcess) -> None:
    assert detector.node.set_parameters(weights="/nowhere/shapes.safetensors") == ""
    detector.bring_to("inactive")
    assert not detector.transition("activate")
    problem = detector.status()["last problem"]
    assert "/nowhere/shapes.safetensors" in problem
    assert "check the path" in problem
    assert detector.node.state() == "inactive"
    assert detector.node.set_parameters(weights=WEIGHTS) == ""
    assert detector.transition("activate")
    assert len(detector.look().scores) > 0


def test_activate_names_a_class_that_the_model_does_not_have(detector: DetectorProcess) -> None:
    assert detector.node.set_parameters(classes=["squaer"]) == ""
    detector.bring_to("inactive")
    assert not detector.transition("activate")
    assert "Did you mean 'square'?" in detector.status()["last problem"]


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("state", STATES)
def test_a_signal_ends_the_process_cleanly(state: str, signal_number: signal.Signals) -> None:
    with detector_process(*as_arguments(PARAMETERS)) as detector:
        detector.bring_to(state)
        if state == "active":
            detector.look()
        assert detector.process.stop(signal_number, timeout_s=PATIENCE_S) == 0
    assert "Traceback" not in detector.process.output


def test_the_transition_shutdown_is_answered_and_ends_the_process_cleanly() -> None:
    with detector_process(*as_arguments(PARAMETERS)) as detector:
        detector.bring_to("active")
        assert detector.transition("shutdown")
        assert detector.node.state() == "finalized"
        assert detector.process.wait(PATIENCE_S) == 0
    assert "Traceback" not in detector.process.output


# What deactivate gives back


@pytest.fixture(scope="module")
def large_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file whose network takes 85 MB."""
    path = tmp_path_factory.mktemp("large") / "yolov5m.safetensors"
    write_safetensors(blank_model(SIZES["m"]), path)
    return path


@pytest.mark.parametrize("runtime", ["torch", "onnxruntime", "openvino"])
def test_deactivate_gives_the_memory_of_the_model_back(
    detector: DetectorProcess, large_weights: Path, runtime: str
) -> None:
    if runtime != "torch":
        pytest.importorskip(runtime)
    assert detector.node.set_parameters(weights=str(large_weights), runtime=runtime, image_size=64) == ""
    detector.bring_to("active")
    detector.bring_to("inactive")  # what a runtime brings once, its code, stays
    before_mb = resident_mb(detector.process.process_id)
    for _ in range(2):
        detector.bring_to("active")
        assert resident_mb(detector.process.process_id) > before_mb + 80
        detector.bring_to("inactive")
        assert resident_mb(detector.process.process_id) < before_mb * 1.1


# Parameter files as people write them


@pytest.mark.parametrize(
    ("classes", "meant", "found"),
    [
        ("[]", [], CLASS_NAMES),
        ("[0, 2]", ["0", "2"], ("circle", "triangle")),
        ("[circle]", ["circle"], ("circle",)),
    ],
)
def test_a_parameter_file_is_taken_as_it_is_meant(
    tmp_path: Path, classes: str, meant: list[str], found: tuple[str, ...]
) -> None:
    text = f"weights: {WEIGHTS}\nimage_size: 320\nconfidence_threshold: 1\ndevice: 0\nclasses: {classes}"
    with detector_process(*parameter_file(tmp_path, text)) as detector:
        detector.bring_to("inactive")
        assert detector.node.parameter("confidence_threshold") == 1.0
        assert detector.node.parameter("classes") == meant
        if not torch.cuda.is_available():
            assert not detector.transition("activate")
            problem = detector.status()["last problem"]
            assert "cuda:0" in problem
            assert "cpu" in problem
        assert detector.node.set_parameters(device="cpu", confidence_threshold=0.25) == ""
        detector.bring_to("active")
        assert set(detector.look().class_names) == set(found)


def test_every_mistake_in_a_parameter_file_is_named_and_can_be_mended(tmp_path: Path) -> None:
    lines = ["confidance_threshold: 0.5", "iou_threshold: 1.5", "max_detections: many", "precision: half"]
    text = "\n".join([*lines, "image_size: 321"])
    with detector_process(*parameter_file(tmp_path, text)) as detector:
        assert not detector.transition("configure")
        told = detector.status()["last problem"]
        for word in (
            "confidance_threshold",
            "Did you mean 'confidence_threshold'?",
            "iou_threshold: 1.5",
            "max_detections: 'many'",
            "precision: 'half'",
            "image_size: 321",
        ):
            assert word in told
            assert word in detector.process.output
        mended = {"iou_threshold": 0.5, "max_detections": 10, "precision": "auto"}
        assert detector.node.set_parameters(confidence_threshold=0.5, **mended, **PARAMETERS) == ""
        detector.bring_to("active")
        assert len(detector.look().scores) > 0


def test_parameter_files_that_cannot_be_read_are_reported_at_the_start(tmp_path: Path) -> None:
    absent = str(tmp_path / "absent.yaml")
    aliases = tmp_path / "aliases.yaml"
    lines = [f"l{level}: &l{level} [{f'*l{level - 1}, ' * 10}]" for level in range(1, 12)]
    aliases.write_text(
        "\n".join(["/**:", "  ros__parameters:", "    l0: &l0 [x]", *(f"    {line}" for line in lines)])
    )
    arguments = parameter_file(tmp_path, "autostart: true\nclasses: [circle, 0.5]")
    arguments += ["--params-file", absent, "--params-file", str(aliases)]
    with detector_process(*arguments) as detector:
        reasons = [
            "line 4: a list must hold values of one type, this one has 'circle' and 0.5: "
            'write ["circle", "0.5"]',
            f"{absent}: No such file or directory",
            "aliases.yaml: line 4: an alias (*l0)",
        ]
        for _ in range(2):
            told = detector.status()
            assert told["level"] == "ERROR"
            for reason in reasons:
                assert reason in told["message"]
                assert reason in detector.process.output
            assert not detector.transition("configure")
        assert "Failed to parse global arguments" not in detector.process.output
        assert detector.node.state() == "unconfigured"
        assert detector.process.stop(signal.SIGTERM, timeout_s=PATIENCE_S) == 0


# What was compiled


def test_what_was_compiled_and_damaged_since_is_made_anew(active: DetectorProcess) -> None:
    pytest.importorskip("onnxruntime")
    assert active.node.set_parameters(runtime="onnxruntime") == ""
    expected = Sighting.now(active.detect(scene_image(7)))
    assert active.transition("deactivate")
    damaged = b"damaged"
    for file in cache_folder("compiled").iterdir():
        file.write_bytes(damaged)
    assert active.transition("activate")
    found = Sighting.now(active.detect(scene_image(7)))
    assert found.class_names == expected.class_names
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-5)
    assert any(file.read_bytes() != damaged for file in cache_folder("compiled").iterdir())
