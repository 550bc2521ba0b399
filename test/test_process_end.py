"""How the detector's process ends when it cannot start, its command line is wrong or its model misbehaves."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from detector_process import environment, scene_image
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.detector import EXIT_DEVICE_LOST
from yolov5_lifecycle.ros.domain import own_domain
from yolov5_lifecycle.ros.observer import Observer

REPOSITORY = Path(__file__).parents[1]
SCRIPT = Path(__file__).with_name("faulty_detector.py")


@contextmanager
def faulty_detector(fault: str) -> Iterator[tuple[ChildProcess, Observer]]:
    """A detector that starts by itself and has `fault`."""
    command = [sys.executable, str(SCRIPT), fault, "--ros-args", "-p", "autostart:=true"]
    with (
        own_domain() as domain,
        ChildProcess("detector", command, environment(domain)) as process,
        closing(Observer("client", domain=domain)) as observer,
    ):
        yield process, observer


def send_until(observer: Observer, is_done: Callable[[], bool], what: str) -> None:
    """Publish pictures to the node until `is_done()`."""
    observer.create_subscription(Detection2DArray, "/yolov5/detections", lambda _: None, 10)
    publisher = observer.create_publisher(Image, "/yolov5/image_raw", 1)

    def is_over() -> bool:
        publisher.publish(scene_image())
        return is_done()

    observer.wait_for(is_over, what)


def test_a_lost_device_ends_the_process_with_its_own_code() -> None:
    with faulty_detector("lose_device") as (process, observer):
        send_until(observer, lambda: "fallen off the bus" in process.output, "the fault")
        assert process.wait(10) == EXIT_DEVICE_LOST


def ask_for_another_model(observer: Observer, process: ChildProcess) -> None:
    """Set a parameter that needs a reload, and wait until that has begun."""
    client = observer.create_client(SetParametersAtomically, "/yolov5/set_parameters_atomically")
    observer.wait_for(client.service_is_ready, "the service of parameters")
    parameter = Parameter("image_size", value=320).to_parameter_msg()

    def is_loading() -> bool:
        client.call_async(SetParametersAtomically.Request(parameters=[parameter]))
        return "loading slowly" in process.output

    observer.wait_for(is_loading, "the reload")


@pytest.mark.parametrize("fault", ["hang", "load_slowly", "reload_slowly"])
def test_a_signal_ends_the_process_in_time_whatever_hangs(fault: str) -> None:
    with faulty_detector(fault) as (process, observer):
        if fault == "hang":
            send_until(observer, lambda: "hanging" in process.output, "the model")
        elif fault == "load_slowly":
            observer.wait_for(lambda: "loading slowly" in process.output, "the model")
        else:
            observer.wait_for(lambda: "active with" in process.output, "the first model")
            ask_for_another_model(observer, process)
        begun_s = time.monotonic()
        assert process.stop(signal.SIGTERM, timeout_s=10) == 0
        assert time.monotonic() - begun_s < 5
    assert "Traceback" not in process.output


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("name", ["camera", "detector"])
def test_a_signal_ends_the_process_cleanly_while_it_imports(name: str, signal_number: signal.Signals) -> None:
    told_imports = os.environ | {"PYTHONPROFILEIMPORTTIME": "1"}
    with ChildProcess(name, [entry_point(name)], told_imports) as process:
        process.wait_for_output(" rclpy\n", 60)
        assert process.stop(signal_number) == 0
    assert "Traceback" not in process.output


ENDED_BEFORE_THE_FIRST_TURN = """
import os
import signal
import threading
from yolov5_lifecycle.ros import detector

default = signal.getsignal(signal.SIGTERM)

def end():
    while signal.getsignal(signal.SIGTERM) is default:  # until the process obeys it
        pass
    os.kill(os.getpid(), signal.SIGTERM)

threading.Thread(target=end).start()
detector.main([])
"""


def test_a_signal_before_the_first_callback_ends_the_process_without_a_word(ros_domain: int) -> None:
    command = [sys.executable, "-c", ENDED_BEFORE_THE_FIRST_TURN]
    with ChildProcess("detector", command, environment(ros_domain)) as process:
        assert process.wait(60) == 0
    assert "Warning" not in process.output
    assert "Traceback" not in process.output


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        pytest.param(["--help"], 0, ["confidence_threshold  ", "Default: 0.25"], id="help"),
        pytest.param(
            ["--device", "cpu", "--ros-args", "--params-file", "/nowhere.yaml"],
            2,
            ["not understood: --device cpu\n", "device  "],
            id="stray words",
        ),
        pytest.param(
            ["--ros-args", "-p", "use_sim_time:=1"], 2, ["'use_sim_time'"], id="a parameter of ROS's own"
        ),
    ],
)
def test_the_command_line_is_explained(words: list[str], code: int, told: list[str]) -> None:
    with ChildProcess("detector", [entry_point("detector"), *words], os.environ) as process:
        assert process.wait(60) == code
    assert all(word in process.output for word in told), process.output
    assert "Traceback" not in process.output


@pytest.mark.parametrize(
    ("command", "package"),
    [("detector", "torch"), ("detector", "pydantic"), ("detector", "rclpy"), ("camera", "cv2")],
)
def test_a_python_that_lacks_a_package_is_named_in_one_line(command: str, package: str) -> None:
    without = f"import sys; sys.modules['{package}'] = None"
    program = f"{without}; from yolov5_lifecycle.ros.{command}_command import main; main()"
    run = subprocess.run(
        [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, timeout=60
    )
    assert (run.returncode, run.stdout) == (1, "")
    (line,) = run.stderr.splitlines()
    assert line.startswith(f"{command}: {sys.executable} cannot import")
    assert package in line.partition(". The node")[0]
