"""The configurations for other programs are valid and name what the node really has."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.colcon_workspace import COMMANDS, PACKAGE, REPOSITORY
from support.detector_process import NODE

from yolov5_lifecycle.ros.topics import published, subscribed
from yolov5_lifecycle.settings.parameter_file import file_values
from yolov5_lifecycle.settings.settings import SETTINGS, Settings, validated

CONFIG = REPOSITORY / "config"
UNITS = {name: CONFIG / f"{name}.service" for name in ("yolov5", "yolov5_console")}
PARAMETER_FILES = [file for file in CONFIG.glob("*.yaml") if not file.name.startswith("nav2")]
TOPICS = {name.replace("~", NODE) for name in (*published(("",)), *subscribed(("",)))} | {"/diagnostics"}


def settings_of(file: Path) -> Settings:
    return validated(file_values(file, NODE))


def values(tree: Any, key: str) -> Iterator[Any]:
    """Whatever stands under `key`, at any depth."""
    if isinstance(tree, dict):
        for name, value in tree.items():
            if name == key:
                yield value
            yield from values(value, key)
    elif isinstance(tree, list):
        for value in tree:
            yield from values(value, key)


@pytest.mark.parametrize("name", ["yolov5", "two_cameras"])
def test_rviz_shows_topics_of_the_node_with_what_their_publishers_offer(name: str) -> None:
    cameras = settings_of(CONFIG / "two_cameras.yaml").cameras if name == "two_cameras" else ("",)
    topics = {topic.replace("~", NODE) for topic in (*published(cameras), *subscribed(cameras))}
    displays = yaml.safe_load((CONFIG / f"{name}.rviz").read_text())["Visualization Manager"]["Displays"]
    shown = {each["Topic"]["Value"]: each for each in displays if "Topic" in each}
    assert {topic for topic in topics if topic.endswith("/image")} <= shown.keys() <= topics
    for topic, display in shown.items():
        expected = "Best Effort" if topic.endswith("image_raw") else "Reliable"
        assert display["Topic"]["Reliability Policy"] == expected
        assert not (display["Enabled"] and topic.endswith("detections_3d")), "no plugin everywhere"


def test_parameter_files_of_the_detector_are_valid_and_two_cameras_have_settings_of_each() -> None:
    settings = {file.name: settings_of(file) for file in PARAMETER_FILES}["two_cameras.yaml"]
    front, rear = map(settings.for_camera, settings.cameras)
    assert (front.max_rate, rear.max_rate) == (10.0, 5.0)
    assert (front.classes, rear.classes) == (("circle", "star"), ())


def test_foxglove_shows_every_panel_once_and_topics_of_the_node() -> None:
    layout = json.loads((CONFIG / "foxglove.json").read_text())
    text = json.dumps(layout["layout"])
    assert all(text.count(json.dumps(panel)) == 1 for panel in layout["configById"])
    named = [*values(layout, "imageTopic"), *values(layout, "topicPath"), *values(layout, "topicToRender")]
    assert len(named) == 3
    assert {name.partition(".")[0] for name in named} <= TOPICS
    assert list(values(layout, "selectedHardwareId")) == [NODE]


def test_the_manager_of_nav2_drives_the_node_without_a_bond() -> None:
    (parameters,) = yaml.safe_load((CONFIG / "nav2_lifecycle_manager.yaml").read_text()).values()
    assert parameters["ros__parameters"] == {
        "node_names": [NODE.removeprefix("/")],
        "autostart": True,
        "bond_timeout": 0.0,
    }
    assert isinstance(parameters["ros__parameters"]["bond_timeout"], float), "nav2 declares a double"
    assert Settings().bond_timeout == 0.0, "what the manager expects of the node"


def unit(name: str = "yolov5") -> dict[str, list[str]]:
    entries: dict[str, list[str]] = {}
    for line in UNITS[name].read_text().splitlines():
        if line and line[0] not in "#[":
            key, _, value = line.partition("=")
            entries.setdefault(key, []).append(value)
    return entries


@pytest.mark.parametrize("name", UNITS)
def test_systemd_starts_a_node_of_a_workspace(name: str) -> None:
    (command,) = unit(name)["ExecStart"]
    shell, option, script = shlex.split(command)
    assert (shell, option) == ("/bin/bash", "-c")
    assert subprocess.run(["bash", "-n", "-c", script]).returncode == 0
    (executable,) = re.findall(rf"install/{PACKAGE}/lib/{PACKAGE}/(\w+)", script)
    assert executable in COMMANDS
    assert set(re.findall(r"-p (\w+):=", script)) <= {setting.name for setting in SETTINGS}
    variables = {entry.lstrip('"').partition("=")[0] for entry in unit(name)["Environment"]}
    assert unit(name)["Restart"] == ["on-failure"]
    assert set(re.findall(r"\$(\w+)", script)) <= variables
    # Without quotation marks systemd takes a second word for another variable.
    assert name == "yolov5" or '"CONSOLE_ARGUMENTS="' in unit(name)["Environment"]


def test_a_unit_leaves_the_shared_memory_of_other_nodes_alone_and_the_detector_has_its_gpu() -> None:
    """RemoveIPC= deletes what the user has in /dev/shm; a private network or IP filter hides other nodes."""
    harmful = {"RemoveIPC", "PrivateNetwork", "IPAddressDeny", "TemporaryFileSystem", "InaccessiblePaths"}
    assert [name for name in UNITS if harmful & unit(name).keys()] == []
    entries = unit("yolov5")  # whose runtimes generate code
    assert {"PrivateDevices", "MemoryDenyWriteExecute", "ProcSubset"} & entries.keys() == set()
    assert entries["DeviceAllow"] == ["char-nvidia* rw"]
    assert "modprobe@nvidia_uvm.service" in entries["Wants"][0].split()


@pytest.mark.parametrize(
    ("name", "written"),
    [("yolov5", {"ROS_LOG_DIR", "XDG_CACHE_HOME"}), ("yolov5_console", {"ROS_LOG_DIR", "XDG_STATE_HOME"})],
)
def test_a_unit_can_write_the_folders_that_it_names(name: str, written: set[str]) -> None:
    entries = unit(name)
    assert (entries["ProtectSystem"], entries["ProtectHome"]) == (["strict"], ["read-only"])
    kinds = {"%L": "LogsDirectory", "%C": "CacheDirectory", "%S": "StateDirectory"}
    folders = dict(entry.split("=", 1) for entry in entries["Environment"] if "=%" in entry)
    assert folders.keys() == written
    for folder in folders.values():
        kind, _, subfolder = folder.partition("/")
        assert entries[kinds[kind]] == [subfolder]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
def test_systemd_understands_the_units_and_finds_them_little_exposed(tmp_path: Path) -> None:
    for name, file in UNITS.items():
        read = run("systemd-analyze", "verify", "--man=no", shutil.copy(file, tmp_path))
        assert f"{name}.service:" not in read.stderr, read.stderr
    for file in UNITS.values():
        found = run("systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=25", file)
        if "--offline" in found.stderr:
            pytest.skip("systemd 250 or newer is needed")
        assert found.returncode == 0, found.stdout


def run(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
