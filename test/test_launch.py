"""The launch files: what they name exists, and where launch_ros is installed they start what they should."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from support.colcon_workspace import PACKAGE, REPOSITORY
from support.detector_process import PARAMETERS, environment
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.ros.child_process import ChildProcess
from yolov5_lifecycle.ros.observer import Observer, RemoteLifecycleNode

pytestmark = pytest.mark.long

FILES = sorted((REPOSITORY / "launch").glob("*.launch.py"))
DETECTOR, DEMO = (REPOSITORY / "launch" / f"{name}.launch.py" for name in ("yolov5", "demo"))
FROM_ROS = {"launch", "launch_ros"}
START_S = 200.0
"""Launch, a node with its imports, and a model whose runtime is chosen."""
LAUNCH = """
import signal
import sys
from launch import LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever starts the tests may ignore it
service = LaunchService()
service.include_launch_description(
    IncludeLaunchDescription(
        PythonLaunchDescriptionSource(sys.argv[1]),
        launch_arguments=[word.split(":=", 1) for word in sys.argv[2:]],
    )
)
sys.exit(service.run())
"""
ROBOT = """
import json
import os
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

def generate_launch_description():
    source = PythonLaunchDescriptionSource(os.environ["INCLUDED"])
    arguments = json.loads(os.environ["ARGUMENTS"]).items()
    return LaunchDescription(
        [
            DeclareLaunchArgument("fps", default_value="30"),
            ExecuteProcess(cmd=["sleep", "3600"]),
            GroupAction([IncludeLaunchDescription(source, launch_arguments=arguments)]),
        ]
    )
"""

with_launch = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in FROM_ROS),
    reason="launch and launch_ros are not installed",
)


def test_a_launch_file_uses_each_argument_that_it_declares_and_files_that_there_are() -> None:
    for file in FILES:
        text = file.read_text()
        modules = set(re.findall(r"^ *(?:from|import) (\w+)", text, re.MULTILINE))
        assert modules - set(sys.stdlib_module_names) == FROM_ROS, file.name
        declared = re.findall(r'DeclareLaunchArgument\(\s*"(\w+)"', text)
        assert sorted(declared) == sorted(set(re.findall(r'LaunchConfiguration\("(\w+)"', text))), file.name
        joined = re.findall(r'PathJoinSubstitution\(\[.*?, "(\w+)", "([\w.]+)"\]\)', text)
        assert len(joined) == text.count("PathJoinSubstitution(")
        assert [names for names in joined if not REPOSITORY.joinpath(*names).is_file()] == []


def launch_command(file: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-W", "ignore", "-c", LAUNCH, str(file), *arguments]


def launch_environment(workspace: Path, domain: int) -> dict[str, str]:
    prefix = workspace / "install" / PACKAGE
    return environment(domain) | {"AMENT_PREFIX_PATH": f"{prefix}{os.pathsep}{sys.prefix}"}


@contextmanager
def launched(
    file: Path, workspace: Path, domain: int, *arguments: str
) -> Iterator[tuple[ChildProcess, Observer]]:
    """The launch file, started with the built package, and who observes its nodes."""
    with (
        ChildProcess(
            "launch", launch_command(file, *arguments), launch_environment(workspace, domain)
        ) as process,
        closing(Observer("client", domain=domain, check=process.check_running)) as observer,
    ):
        try:
            yield process, observer
        finally:  # killed, it would leave its nodes behind
            code = process.stop(signal.SIGINT)
        assert code == 0, process.output


@with_launch
def test_the_demo_detects_with_room_for_images(workspace: Path, ros_domain: int) -> None:
    with launched(DEMO, workspace, ros_domain, "rviz:=False") as (process, observer):
        process.wait_for_output("active with weights", START_S)
        received: list[Detection2DArray] = []
        observer.create_subscription(Detection2DArray, "/yolov5/detections", received.append, 10)
        observer.wait_for(lambda: any(message.detections for message in received), "detections")
        nodes = re.findall(r"process started with pid \[(\d+)\]", process.output)
        assert len(nodes) == 2
        for node in nodes:
            assert b"config/shm.xml" in Path(f"/proc/{node}/environ").read_bytes()


def parameter_file(folder: Path, **parameters: object) -> str:
    """Path of a new file for any node."""
    path = folder / "parameters.yaml"
    path.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
    return str(path)


def installed(workspace: Path, file: Path) -> Path:
    """`file` in the built package."""
    return workspace / "install" / PACKAGE / "share" / PACKAGE / "launch" / file.name


@with_launch
@pytest.mark.parametrize(
    ("file", "argument", "told"),
    [
        pytest.param(DEMO, "rviz:=true", "RViz is not installed. Install it with `sudo apt", id="no RViz"),
        pytest.param(DEMO, "params_file:=/no/such.yaml", "file at '/no/such.yaml', found no file", id="typo"),
        pytest.param(DETECTOR, "params_file:=~/x.yaml", "Write $HOME instead of ~", id="tilde"),
        pytest.param(DEMO, "autostart:=maybe", "autostart: expected true or false, found 'maybe'", id="word"),
        pytest.param(
            DETECTOR,
            "imge:=/camera/image_raw",
            "Unknown launch argument 'imge'. Did you mean 'image'? The arguments are: autostart, console,",
            id="unknown name",
        ),
        pytest.param(
            DETECTOR,
            "log_level:=warning",
            "log_level: expected debug, info, warn, error, fatal, or LOGGER:=LEVEL for one logger, found "
            "'warning'. Did you mean 'warn'?",
            id="log level",
        ),
        pytest.param(DETECTOR, "log_level:=yolov5:=debg", "Did you mean 'debug'?", id="level of a logger"),
        pytest.param(
            DETECTOR,
            "console_arguments:='--port 1",
            "console_arguments: expected words as in a shell, found ''--port 1' (No closing quotation).",
            id="open quote",
        ),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_started(
    workspace: Path, ros_domain: int, file: Path, argument: str, told: str
) -> None:
    command = launch_command(installed(workspace, file), argument)
    with ChildProcess("launch", command, launch_environment(workspace, ros_domain)) as process:
        assert process.wait(60) == 1
    assert told in process.output
    assert "process started" not in process.output


@with_launch
def test_a_launch_file_that_includes_the_detector_wrongly_ends_with_its_own_processes(
    workspace: Path, ros_domain: int, tmp_path: Path
) -> None:
    robot = tmp_path / "robot.launch.py"
    robot.write_text(ROBOT)
    variables = {"INCLUDED": str(installed(workspace, DETECTOR)), "ARGUMENTS": json.dumps({"imge": "/x"})}
    command = launch_command(robot, "fps:=15", "name_of_nothing:=1")
    with ChildProcess("launch", command, launch_environment(workspace, ros_domain) | variables) as process:
        assert process.wait(60) == 1
    assert "Did you mean 'image'?" in process.output
    assert "detector" not in re.findall(r"\[(\w+)-\d+\]: process started", process.output)
    assert re.search(r"process has died \[pid \d+, exit code -2, cmd 'sleep 3600'\]", process.output)


@with_launch
@pytest.mark.parametrize(
    ("autostart", "state"),
    [("True", "active"), ("false", "unconfigured")],
)
def test_the_node_of_a_namespace_starts_as_asked(
    workspace: Path, ros_domain: int, tmp_path: Path, autostart: str, state: str
) -> None:
    arguments = {
        "namespace": "robot",
        "image": "/camera/image_raw",
        "detections": "/robot/seen",
        "params_file": parameter_file(tmp_path, **PARAMETERS, lazy=False),
        "autostart": autostart,
        "log_level": "info",
    }
    words = [f"{name}:={value}" for name, value in arguments.items()]
    with launched(DETECTOR, workspace, ros_domain, *words) as (process, observer):
        process.wait_for_output("[robot.yolov5]: unconfigured", START_S)
        node = RemoteLifecycleNode(observer, "/robot/yolov5")
        node.wait_until_reachable()
        observer.wait_for(lambda: node.state() == state, f"the state {state}")
        subscribers = 1 if state == "active" else 0
        observer.wait_for(
            lambda: observer.count_subscribers("/camera/image_raw") == subscribers, "the subscription"
        )
        observer.wait_for(lambda: observer.count_publishers("/robot/seen") == subscribers, "the publisher")


@with_launch
def test_a_start_that_fails_is_reported_and_the_node_stays(
    workspace: Path, ros_domain: int, tmp_path: Path
) -> None:
    file = parameter_file(tmp_path, weights="/absent.pt")
    with launched(DETECTOR, workspace, ros_domain, f"params_file:={file}") as (process, observer):
        process.wait_for_output("activate refused", START_S)
        told: list[DiagnosticStatus] = []
        observer.create_subscription(
            DiagnosticArray, "/diagnostics", lambda message: told.extend(message.status), 10
        )
        observer.wait_for(lambda: bool(told), "diagnostics")
        assert told[-1].level == DiagnosticStatus.ERROR
        assert "activate refused" in told[-1].message
        node = RemoteLifecycleNode(observer, "/yolov5")
        node.wait_until_reachable()
        assert node.state() == "inactive"


@with_launch
def test_a_process_that_dies_is_restarted(workspace: Path, ros_domain: int, tmp_path: Path) -> None:
    arguments = [f"params_file:={parameter_file(tmp_path, **PARAMETERS)}", "respawn:=True"]
    with launched(DETECTOR, workspace, ros_domain, *arguments) as (process, observer):
        process.wait_for_output("active with weights", START_S)
        (process_id,) = re.findall(r"process started with pid \[(\d+)\]", process.output)
        os.kill(int(process_id), signal.SIGKILL)
        observer.wait_for(
            lambda: process.output.count("active with weights") == 2, "the second process", timeout_s=START_S
        )


@with_launch
@pytest.mark.skipif(importlib.util.find_spec("uvicorn") is None, reason="uvicorn is not installed")
def test_the_console_starts_beside_the_detector_and_ends_with_it(workspace: Path, ros_domain: int) -> None:
    arguments = ["console:=true", "console_arguments:=--port 0 --view-only", "autostart:=false"]
    with launched(DETECTOR, workspace, ros_domain, *arguments) as (process, _):
        process.wait_for_output("console: http://127.0.0.1:", START_S)
        address = re.findall(r"http://127\.0\.0\.1:\d+", process.output)[0]
        with urllib.request.urlopen(address, timeout=30) as page:
            assert b"<title>" in page.read()
    assert "Traceback" not in process.output
