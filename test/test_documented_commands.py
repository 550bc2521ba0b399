"""README and docs: our commands are run or have a reason why not, others are checked against the code."""

from __future__ import annotations

import hashlib
import importlib
import os
import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rclpy.parameter import Parameter, get_parameter_value, parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.rosbag2 import StoragePlugin
from sensor_msgs.msg import Image
from support.candidates import keep
from support.checkpoint_builder import official_model, saved, stripped
from support.colcon_workspace import COMMANDS, PACKAGE, REPOSITORY
from support.detector_process import NODE, STEPS, environment
from support.file_server import FileServer, sending_ranges
from support.pages import (
    PAGES,
    TOPICS,
    TUTORIAL,
    blocks,
    typed,
)
from support.recorded_scene import images, jpeg, raw, record, video
from support.small_families import segmentation_checkpoint

from tools.shapes import dataset
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota
from yolov5_lifecycle.commands import convert, fetch_weights
from yolov5_lifecycle.commands.entry_points import MODULES
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.ros.parameters.declaration import value_of
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS_BY_NAME, validated

OF_OTHERS = (
    *("sudo", "git", "cd", "mkdir", "source", "export", "pixi", "docker", "podman", "journalctl"),
    *("rviz2", "python3", ".venv/bin/python -c", "~/yolov5_venv/bin/", "~/yolov5_release/bin/"),
    *("ros2 run rqt_image_view", "ros2 run tf2_ros", "ros2 run nav2_lifecycle_manager", "ros2 security"),
    "ros2 run depth_image_proc",
)
"""How the commands of other programs begin."""
NOT_RUN = {
    "camera --ros-args -p source:=0 ": "needs a webcam",
    "camera --ros-args -p source:=rtsp:": "needs a network camera; test_network_stream.py has one of HTTP",
    'camera --ros-args -p "source:=v4l2src ': "needs a webcam and GStreamer",
    "detector --ros-args -p device:=cuda ": "needs a GPU",
    "doctor": "takes a minute; test/doctor/ and test/ros/doctor/ run it",
    "console": "serves until Ctrl-C; test/ros/console/ starts it with these options",
}
"""How a command of this package begins, and why it is not tried."""

MAKEFILE = (REPOSITORY / "Makefile").read_text()
ADDITIONS = {
    "detector": ["-p", "autostart:=true", "-p", "runtime:=torch"],
    "camera": ["-p", "rate:=5.0", "-p", "loop:=true"],
}
"""What the tests put behind the command of a node: it shows that it works, and leaves room for the others."""
REFUSED = {"detect_bag two_cameras --output found"}
"""Commands of which the pages show the error."""
CAMERAS = ("/front/image_raw", "/rear/image_raw")
"""The topics of the recording that has more than one."""
CLASS_NAMES = ("person", "cup", "car")
"""The classes of the model that stands in for the official ones and the reader's own."""


def of_package(command: str) -> str:
    """The command as one for a console script of this package; "" when it is none."""
    words = command.removeprefix(f"ros2 run {PACKAGE} ")
    return words if words.split()[0] in COMMANDS else ""


COMMANDS_OF_PAGES = list(dict.fromkeys(line.strip() for page in PAGES for line in typed(page)))
"""What a reader may type: the lines of the console blocks."""


def check_make(target: str, *assignments: str) -> None:
    assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE)
    for assignment in assignments:
        variable, _, value = assignment.partition("=")
        assert re.search(rf"^{variable} \?=", MAKEFILE, re.MULTILINE)
        if started := re.search(rf"python -m (\S+) \$\({variable}\)", MAKEFILE):
            check_module(started[1], *shlex.split(value))


def check_param(verb: str, node: str, name: str = "", value: str = "") -> None:
    assert node == NODE
    if verb == "set":
        given = parameter_value_to_python(get_parameter_value(value))
        meant = value_of(Parameter(name, value=given), SCHEMA.find(name))
        assert SCHEMA.problem(name, meant) is None
    else:
        assert verb in ("get", "describe", "delete", "dump")
        assert (name == "") if verb == "dump" else (SCHEMA.find(name) is not None)


def check_lifecycle(verb: str, node: str, transition: str = "") -> None:
    assert (verb, node) == ("set", NODE)
    assert transition in {*STEPS.values(), "shutdown"}


def check_topic(verb: str, *words: str) -> None:
    assert verb in ("hz", "echo", "info")
    (topic,) = [word for word in words if not word.startswith("--")]
    assert topic.replace(NODE, "~", 1) in TOPICS


def check_launch(package: str, file: str, *arguments: str) -> None:
    assert package == PACKAGE
    declared = re.findall(r'DeclareLaunchArgument\(\s*"(\w+)"', (REPOSITORY / "launch" / file).read_text())
    assert {argument.partition(":=")[0] for argument in arguments} <= set(declared)


def check_module(module: str, *words: str) -> None:
    is_folder = REPOSITORY.joinpath(*module.split(".")).is_dir()
    importlib.import_module(f"{module}.__main__" if is_folder else module).parser().parse_args(words)


def check_service(verb: str, service: str, service_type: str, request: str = "{}") -> None:
    assert verb == "call"
    if (service, service_type) == (f"{NODE}/collect", "std_srvs/srv/Trigger"):
        assert request == "{}"
        return
    assert service == f"{NODE}/set_parameters_atomically"
    assert service_type == "rcl_interfaces/srv/SetParametersAtomically"
    messages = [
        ParameterMessage(name=parameter["name"], value=ParameterValue(**parameter["value"]))
        for parameter in yaml.safe_load(request)["parameters"]
    ]
    parameters = map(Parameter.from_parameter_msg, messages)
    validated({one.name: value_of(one, SETTINGS_BY_NAME[one.name]) for one in parameters})


CHECKS: dict[str, Callable[..., None]] = {
    "make": check_make,
    ".venv/bin/python -m": check_module,
    "python -m": check_module,
    "ros2 param": check_param,
    "ros2 lifecycle": check_lifecycle,
    "ros2 service": check_service,
    "ros2 topic": check_topic,
    "ros2 launch": check_launch,
    "PYTHONPATH=test python -m": check_module,
}


def check_of(command: str) -> str:
    """The key of CHECKS that is for it, else ""."""
    return next((start for start in CHECKS if command.startswith(f"{start} ")), "")


def test_a_command_is_run_or_checked_or_of_another_program() -> None:
    others = [each for each in COMMANDS_OF_PAGES if not (check_of(each) or of_package(each))]
    assert [each for each in others if not each.startswith(OF_OTHERS)] == [], "add to CHECKS, or to OF_OTHERS"


@pytest.mark.parametrize("start", CHECKS)
def test_a_command_of_ros_or_make_names_only_what_exists(start: str) -> None:
    for command in (each for each in COMMANDS_OF_PAGES if check_of(each) == start):
        CHECKS[start](*shlex.split(command.removeprefix(start)))


# What this package installs is run, in a home with the files that the pages speak of.


@pytest.fixture(scope="module")
def checkpoint() -> bytes:
    return saved(stripped(official_model(names=CLASS_NAMES)))


@pytest.fixture
def home(tmp_path: Path, checkpoint: bytes, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The reader's, and the folder in which the commands are typed."""
    for folder in ("config", "docs", "weights"):
        (tmp_path / folder).symlink_to(REPOSITORY / folder)
    for name in ("best.pt", "new.pt", "yolov5n.pt", "models/best.pt", ".ros/yolov5/yolov5n.pt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(checkpoint)
    (tmp_path / "models" / "yolov5n-seg.pt").write_bytes(segmentation_checkpoint())
    (tmp_path / "my_detector.yaml").write_text(blocks(TUTORIAL, "yaml")[0])
    record(tmp_path / "drive", [raw(0)], storage=StoragePlugin.MCAP)
    dataset.write_dataset(tmp_path / "shapes", images=2)
    quota = Quota(max_bytes=1 << 20, max_frames=9, min_free_bytes=0)
    for seed, folder in enumerate(("corrected", "collected", "collected")):
        with closing(CollectedFolder(tmp_path / folder, quota)) as collected:
            keep(collected, seed, names=CLASS_NAMES)
    (tmp_path / "drives").mkdir()
    for name in ("drives/monday", "drives/tuesday"):
        record(tmp_path / name, [raw(0)], storage=StoragePlugin.MCAP)
    record(tmp_path / "two_cameras", [raw(0)], storage=StoragePlugin.SQLITE3, topics=CAMERAS)
    for folder in ("shots", "images"):
        images(tmp_path / folder)
    (tmp_path / "image.jpg").write_bytes(bytes(jpeg(0).data))
    (tmp_path / "videos").mkdir()
    for name in ("video.mp4", "drive.mp4", "videos/wednesday.mp4"):
        video(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


@pytest.fixture
def _mirror(checkpoint: bytes, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The official models come from this machine."""
    with FileServer(sending_ranges(checkpoint)) as server:
        monkeypatch.setenv("YOLOV5_WEIGHTS_URL", f"{server.address}/yolov5{{size}}.pt")
        digest = hashlib.sha256(checkpoint).hexdigest()
        monkeypatch.setattr(fetch_weights, "SHA256", dict.fromkeys(fetch_weights.SHA256, digest))
        yield


OURS = [
    command
    for command in dict.fromkeys(map(of_package, COMMANDS_OF_PAGES))
    if command and not command.startswith(tuple(NOT_RUN))
]
NODES = [command for command in OURS if "--ros-args" in command]
AT_ONCE = 4


@pytest.mark.long
@pytest.mark.usefixtures("home", "_mirror")
@pytest.mark.parametrize("command", [command for command in OURS if command not in NODES])
def test_a_command_that_ends_does_so_as_the_pages_say(command: str) -> None:
    name, *words = shlex.split(command)
    assert importlib.import_module(MODULES[name]).main(words) == (1 if command in REFUSED else 0)


@pytest.mark.long
@pytest.mark.parametrize("nodes", [NODES[first : first + AT_ONCE] for first in range(0, len(NODES), AT_ONCE)])
def test_every_node_starts_as_the_pages_say(home: Path, ros_domain: int, nodes: list[str]) -> None:
    convert.main(["best.pt", "best.safetensors"])
    with ExitStack() as stack:
        processes = [stack.enter_context(typed_in(home, node, ros_domain)) for node in nodes]
        observer = stack.enter_context(closing(Observer("client", domain=ros_domain)))
        for process in processes:
            if process.name.startswith("detector"):
                process.wait_for_output(last_words(process.name), 240)
            else:
                wait_for_an_image(observer, process.name)
        for process in processes:
            process.check_running()


def last_words(detector: str) -> str:
    """What a detector prints once it works, or once it has told what this machine lacks."""
    lacks_tf2 = "target_frame:=" in detector and find_spec("tf2_ros") is None
    return "sudo apt install ros-jazzy-tf2-ros-py" if lacks_tf2 else "active with weights"


def typed_in(home: Path, node: str, domain: int) -> ChildProcess:
    name, *words = shlex.split(os.path.expandvars(node.replace("$PWD", str(home))))
    return ChildProcess(node, [entry_point(name), *words, *ADDITIONS[name]], environment(domain))


def wait_for_an_image(observer: Observer, camera: str) -> None:
    remapped = re.search(r" -r image_raw:=(\S+)", camera)
    topic = remapped[1] if remapped else "/image_raw"
    images: list[Image] = []
    any_camera = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    observer.create_subscription(Image, topic, images.append, any_camera)
    observer.wait_for(lambda: bool(images), f"an image on {topic}")
