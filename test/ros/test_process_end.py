"""How the detector's process ends: on a signal in any state, and when its model misbehaves."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from support.colcon_workspace import SUPPORT, SUPPORT_PATH
from support.detector_process import NODE, environment, scene_image
from support.worker import worker_domain
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.detector.node import EXIT_DEVICE_LOST
from yolov5_lifecycle.ros.observer import PATIENCE_S, Observer

DEVICE_LOST = "exiting (code 3) because the device is lost: DeviceLostError: the GPU fell off the bus"
SCRIPT = SUPPORT / "scripted_detector.py"


@contextmanager
def scripted_detector(script: str) -> Iterator[tuple[ChildProcess, Observer]]:
    """A detector that starts by itself, with models that behave as `script` says."""
    command = [sys.executable, str(SCRIPT), script, "--ros-args", "-p", "autostart:=true"]
    with (
        worker_domain() as domain,
        ChildProcess("detector", command, environment(domain) | SUPPORT_PATH) as process,
        closing(Observer("client", domain=domain)) as observer,
    ):
        yield process, observer


def send_until(observer: Observer, is_done: Callable[[], bool], what: str) -> None:
    """Publish images to the node until `is_done()`."""
    observer.create_subscription(Detection2DArray, f"{NODE}/detections", lambda _: None, 10)
    publisher = observer.create_publisher(Image, f"{NODE}/image_raw", 1)

    def is_over() -> bool:
        publisher.publish(scene_image())
        return is_done()

    observer.wait_for(is_over, what)


@pytest.mark.long
def test_the_loss_of_the_device_is_reported_and_ends_the_process_with_a_code_of_its_own() -> None:
    reports: list[dict[str, str]] = []

    def take(message: DiagnosticArray) -> None:
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            reports.append(values | {"message": status.message})

    with scripted_detector("lose_device") as (process, observer):
        observer.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
        observer.wait_for(lambda: bool(reports), "the first diagnostics")
        assert 10 < float(reports[0]["resident memory MB"]) < 10_000
        send_until(observer, lambda: DEVICE_LOST in process.output, "the loss of the device")
        observer.wait_for(lambda: reports[-1]["message"] == DEVICE_LOST, "the last diagnostics")
        assert process.wait(PATIENCE_S) == EXIT_DEVICE_LOST


def be_active(observer: Observer, process: ChildProcess) -> None:
    observer.wait_for(lambda: "active with" in process.output, "the first model")


def reload(observer: Observer, process: ChildProcess) -> None:
    """Set a parameter that needs another model, and wait until that is being loaded."""
    be_active(observer, process)
    client = observer.create_client(SetParametersAtomically, f"{NODE}/set_parameters_atomically")
    observer.wait_for(client.service_is_ready, "the service of parameters")
    parameter = Parameter("image_size", value=320).to_parameter_msg()

    def is_loading() -> bool:
        client.call_async(SetParametersAtomically.Request(parameters=[parameter]))
        return "loading slowly" in process.output

    observer.wait_for(is_loading, "the reload")


def hang(observer: Observer, process: ChildProcess) -> None:
    send_until(observer, lambda: "hanging" in process.output, "the model")


LOADER_LEFT = "a model is still being loaded or freed: its thread is abandoned"
INFERENCE_LEFT = "inference has still not finished: its thread is abandoned"


@pytest.mark.long
@pytest.mark.parametrize(
    ("script", "come_to", "ending", "left"),
    [
        pytest.param("work", be_active, signal.SIGHUP, [], id="active"),
        pytest.param("work", be_active, signal.SIGINT, [], id="Ctrl-C", marks=pytest.mark.end_to_end),
        pytest.param("reload_slowly", reload, signal.SIGTERM, [LOADER_LEFT], id="reloading"),
        pytest.param("hang", hang, signal.SIGTERM, [INFERENCE_LEFT], id="hanging"),
    ],
)
def test_a_signal_releases_the_model_and_ends_the_process_whatever_hangs(
    script: str, come_to: Callable[[Observer, ChildProcess], None], ending: signal.Signals, left: list[str]
) -> None:
    """What hangs does so for longer than the process is waited for."""
    with scripted_detector(script) as (process, observer):
        come_to(observer, process)
        assert process.stop(ending) == 0
    assert process.output.count("model closed") == 1
    assert [words for words in (LOADER_LEFT, INFERENCE_LEFT) if words in process.output] == left
    assert "Traceback" not in process.output


@pytest.mark.long
def test_a_signal_ends_the_process_cleanly_while_it_imports() -> None:
    told_imports = os.environ | {"PYTHONPROFILEIMPORTTIME": "1"}
    with ChildProcess("detector", [entry_point("detector")], told_imports) as process:
        process.wait_for_output(" rclpy\n", 60)
        assert process.stop(signal.SIGTERM) == 0
    assert "Traceback" not in process.output


ENDED_BEFORE_THE_FIRST_TURN = """
import os
import signal
import threading
from yolov5_lifecycle.ros.detector import command as detector

default = signal.getsignal(signal.SIGTERM)

def end():
    while signal.getsignal(signal.SIGTERM) is default:  # until the process handles it
        pass
    os.kill(os.getpid(), signal.SIGTERM)

threading.Thread(target=end).start()
detector.main([])
"""


@pytest.mark.long
def test_a_signal_before_the_first_callback_ends_the_process_silently(ros_domain: int) -> None:
    command = [sys.executable, "-c", ENDED_BEFORE_THE_FIRST_TURN]
    with ChildProcess("detector", command, environment(ros_domain)) as process:
        assert process.wait(60) == 0
    assert "Warning" not in process.output
    assert "Traceback" not in process.output
