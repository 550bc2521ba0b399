"""The wheel of this package runs with what it declares, outside of the working tree, without and with ROS.

The variable RELEASE_WHEELS names a folder with the wheels of a release, which are then tested instead.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader, StoragePlugin
from support.clean_environment import build_environment, build_wheel
from support.colcon_workspace import COMMANDS, PACKAGE
from support.official_types import OFFICIAL_HASHES
from support.recorded_scene import COUNT, raw, record

pytestmark = pytest.mark.long
NEEDS_ROS = ("camera", "console", "demo", "detector")

RELEASE_WHEELS = os.environ.get("RELEASE_WHEELS")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not RELEASE_WHEELS:
        return build_wheel(tmp_path_factory.mktemp("wheel"))
    (released,) = Path(RELEASE_WHEELS).glob(f"{PACKAGE}-*.whl")
    return released


@pytest.fixture(scope="module")
def executables(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clean") / "environment"
    return build_environment(folder, [wheel], ("bag", "onnxruntime", "opencv"))


@pytest.fixture(scope="module")
def executables_with_ros(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Those of the extra "ros"; the messages are those of the release, or else of the running environment."""
    folder = tmp_path_factory.mktemp("ros") / "environment"
    messages = messages_of_release(f"cp{sys.version_info[0]}{sys.version_info[1]}") if RELEASE_WHEELS else []
    assert len(messages) == bool(RELEASE_WHEELS)
    return build_environment(folder, [wheel, *messages], ("ros",))


def messages_of_release(python: str) -> list[Path]:
    """The wheels of the messages for `python`, a tag such as cp312."""
    return list(Path(RELEASE_WHEELS or "").glob(f"{PACKAGE}_interfaces-*-{python}-*.whl"))


def run(home: Path, *words: str | Path, path: str = os.defpath) -> subprocess.CompletedProcess[str]:
    """Run a command in the folder `home`, without the environment variables of the tests."""
    environment = {"PATH": path, "HOME": str(home)}
    return subprocess.run(words, cwd=home, env=environment, capture_output=True, text=True, check=False)


def test_every_module_that_needs_no_ros_and_no_other_extra_can_be_imported(
    executables: Path, tmp_path: Path
) -> None:
    program = f"""
import importlib, importlib.util, pkgutil
import {PACKAGE} as package
print(package.__file__)
assert importlib.util.find_spec("rclpy") is None
for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
    if ".ros." not in found.name + ".":
        try:
            importlib.import_module(found.name)
        except ImportError as error:
            print(error.name)
"""
    told = run(tmp_path, executables / "python", "-W", "error", "-c", program)
    assert (told.returncode, told.stderr) == (0, "")
    place, *failed = told.stdout.splitlines()
    assert place.startswith(str(executables.parent))
    assert set(failed) == {"openvino"}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_tells_its_version_and_its_arguments_or_that_it_needs_ros(
    command: str, executables: Path, tmp_path: Path
) -> None:
    told = run(tmp_path, executables / command, "--version")
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout.startswith(f"{command} ")
    assert "not installed" not in told.stdout
    told = run(tmp_path, executables / command, "--help")
    if command in NEEDS_ROS:
        assert (told.returncode, told.stdout) == (1, "")
        (line,) = told.stderr.splitlines()
        assert "source ROS first" in line
    else:
        assert (told.returncode, told.stderr) == (0, "")
        assert told.stdout.startswith(f"usage: {command}")


def test_a_recording_is_detected_in(executables: Path, tmp_path: Path) -> None:
    record(tmp_path / "drive", [raw(number) for number in range(COUNT)], storage=StoragePlugin.MCAP)
    weights = f"package://{PACKAGE}/weights/shapes.safetensors"
    words = ["drive", "--output", "found", "--set", f"weights={weights}", "--set", "runtime=onnxruntime"]
    told = run(tmp_path, executables / "detect_bag", *words)
    assert told.returncode == 0, told.stderr
    assert f"{COUNT}: {COUNT} detected, 0 rejected, 0 failed" in told.stderr
    with Reader(tmp_path / "found") as reader:
        assert reader.topics["/yolov5/detections"].msgcount == COUNT


def test_with_the_extra_ros_the_demo_needs_no_compiler_and_no_ros_from_apt(
    executables_with_ros: Path, tmp_path: Path
) -> None:
    told = run(tmp_path, executables_with_ros / "demo", path=str(tmp_path / "no programs"))
    assert told.returncode == 0, told.stdout + told.stderr
    assert told.stdout.splitlines()[-1].startswith("demo ok")


@pytest.mark.skipif(not RELEASE_WHEELS, reason="of a release only; test_interfaces.py asks the running types")
@pytest.mark.parametrize("package", OFFICIAL_HASHES)
def test_the_messages_have_the_official_types_in_the_wheel_of_every_python(package: str) -> None:
    wheels = messages_of_release("*")
    assert wheels
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as files:
            described = [name for name in files.namelist() if f"/share/{package}/msg/" in name]
            descriptions = [json.loads(files.read(name)) for name in described if name.endswith(".json")]
        types = [description["type_hashes"][0] for description in descriptions]
        official = {f"{package}/msg/{name}": value for name, value in OFFICIAL_HASHES[package].items()}
        assert {each["type_name"]: each["hash_string"] for each in types} == official


def test_the_messages_bring_their_licences(executables_with_ros: Path, tmp_path: Path) -> None:
    program = f"""
from importlib.metadata import distribution
for file in distribution("{PACKAGE}_interfaces").files:
    if file.name == "LICENSE":
        print(file.parent.name, file.read_text().split()[0])
"""
    told = run(tmp_path, executables_with_ros / "python", "-c", program)
    assert sorted(told.stdout.splitlines()) == ["bond Copyright", "vision_msgs Apache"], told.stderr
