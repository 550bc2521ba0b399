"""The installed detector as a process, with the embedded model: images, signals, memory."""

from __future__ import annotations

import shutil
import signal
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY
from support.detector_process import (
    NODE,
    SEED,
    DetectorProcess,
    as_arguments,
    detector_process,
    environment,
    parameter_file,
)
from support.random_model import blank_model
from support.runtime_names import EVERY_RUNTIME
from vision_msgs.msg import Detection2DArray

from benchmark.process_memory import resident_mb
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.architecture import SIZES
from yolov5_lifecycle.quantization.calibration_file import path_beside, read_calibration, write_calibration
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.demo.demonstrations import matched
from yolov5_lifecycle.ros.messages import stamp_ns
from yolov5_lifecycle.ros.observer import PATIENCE_S
from yolov5_lifecycle.runtimes.registry import installed_runtimes

SHAPES = REPOSITORY / "weights" / "shapes.safetensors"


@pytest.mark.end_to_end
def test_a_camera_and_the_detector_find_the_shapes_where_they_are(detector: DetectorProcess) -> None:
    truths: dict[int, Detection2DArray] = {}

    def take_truth(message: Detection2DArray) -> None:
        truths[stamp_ns(message.header)] = message

    observer, messages = detector.observer, detector.detections
    subscription = observer.create_subscription(Detection2DArray, "/camera/truth", take_truth, 10)
    assert detector.node.set_parameters(tracker="bytetrack", track_timeout=60.0) == ""
    parameters = {"width": 320, "height": 240, "seed": SEED, "frame_id": "lens"}
    remap = f"image_raw:={NODE}/image_raw"
    command = [entry_point("camera"), "--ros-args", "-r", remap, *as_arguments(parameters)]
    with ChildProcess("camera", command, environment(detector.domain)) as camera:
        observer.wait_for(lambda: bool(truths), "the camera's truth")
        detector.bring_to("active")
        observer.wait_for(lambda: len(messages) >= 60, "60 messages")
        assert {message.header.frame_id for message in messages} == {"lens"}
        pairs = [(truths[stamp], one) for one in messages if (stamp := stamp_ns(one.header)) in truths]
        right = sum(len(matched(truth, found)) for truth, found in pairs)
        assert right > 0.9 * sum(len(truth.detections) for truth, _ in pairs) > 0
        assert {each.id for each in messages[-1].detections} != {""}
        assert detector.transition("deactivate")
        last_ns = stamp_ns(messages[-1].header)
        assert detector.transition("activate")
        observer.wait_for(lambda: stamp_ns(messages[-1].header) > last_ns, "messages once active again")
        assert camera.stop(signal.SIGINT) == 0
    observer.destroy_subscription(subscription)


@pytest.mark.long
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_deactivate_releases_the_memory_of_the_model(
    detector: DetectorProcess, tmp_path: Path, runtime: str
) -> None:
    large = tmp_path / "yolov5m.safetensors"  # whose network takes 85 MB
    write_safetensors(blank_model(SIZES["m"]), large)
    assert detector.node.set_parameters(weights=str(large), runtime=runtime, image_size=64) == ""
    detector.bring_to("active")
    detector.bring_to("inactive")  # what a runtime brings once, its code, stays
    before_mb = resident_mb(detector.process.process_id)
    for _ in range(2):
        detector.bring_to("active")
        assert resident_mb(detector.process.process_id) > before_mb + 80
        detector.bring_to("inactive")
        assert resident_mb(detector.process.process_id) < before_mb * 1.1


@pytest.mark.long
@pytest.mark.skipif("openvino" not in installed_runtimes(), reason="no openvino: make install")
def test_precision_int8_is_a_reload_that_needs_a_calibration_and_goes_on_finding_the_shapes(
    detector: DetectorProcess, tmp_path: Path
) -> None:
    detector.bring_to("active")
    weights = Path(shutil.copy(SHAPES, tmp_path / "best.safetensors"))
    assert detector.node.set_parameters(weights=str(weights)) == ""
    in_fp32 = detector.look(0)
    assert f"`calibrate {weights} DATA --image-size 320`" in detector.node.set_parameters(precision="int8")
    assert detector.status()["precision"] == "fp32"
    calibration = read_calibration(path_beside(SHAPES)).model_copy(update={"image_size": 320})
    write_calibration(path_beside(weights), calibration)
    assert detector.node.set_parameters(precision="int8") == ""
    status = detector.status()
    assert (status["precision"], status["runtime"]) == ("int8", "openvino")
    assert abs(len(detector.look(1).class_names) - len(in_fp32.class_names)) <= 1
    assert detector.node.set_parameters(precision="auto") == ""
    assert detector.status()["precision"] == "fp32"


@pytest.mark.long
def test_parameter_files_that_cannot_be_read_are_reported_at_the_start(tmp_path: Path) -> None:
    absent = str(tmp_path / "absent.yaml")
    arguments = parameter_file(tmp_path, "autostart: true\nclasses: [circle, 0.5]")
    arguments += ["--params-file", absent]
    with detector_process(*arguments) as detector:
        reasons = [
            "line 4: a list must hold values of one type, this one has 'circle' and 0.5: "
            'write ["circle", "0.5"]',
            f"{absent}: No such file or directory",
        ]
        for _ in range(2):
            told = detector.status()
            assert told["level"] == "ERROR"
            for reason in reasons:
                assert reason in told["message"]
                detector.process.wait_for_output(reason, PATIENCE_S)
            assert not detector.transition("configure")
        assert "Failed to parse global arguments" not in detector.process.output
        assert detector.process.stop(signal.SIGTERM) == 0
