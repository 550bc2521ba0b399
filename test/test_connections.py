"""The commands open no connections but those of ROS, and write only the files that docs/security.md names."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys

import pytest
from support.colcon_workspace import REPOSITORY, SUPPORT, SUPPORT_PATH
from support.detector_process import environment
from support.watched_processes import DOMAIN, FOLDERS

pytestmark = pytest.mark.long

PROGRAM = SUPPORT / "watched_processes.py"
ALONE = ["unshare", "--map-root-user", "--net", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
FONTS = r"cache/matplotlib/fontlist-v[\d.]+json"
COMPILED = r"cache/yolov5_lifecycle/compiled/[0-9a-f]{64}"
LOG = r"log/[^/]+\.log"


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, list[str]]]:
    """By command, the packets that were recorded and the files that were written."""
    for runtime in ("onnxruntime", "openvino"):
        if importlib.util.find_spec(runtime) is None:
            pytest.skip(f"no {runtime}: make install")
    if missing := [name for name in ("unshare", "ip", "mount") if shutil.which(name) is None]:
        pytest.skip(f"needs {', '.join(missing)} (util-linux, iproute2)")
    trial = [*ALONE, "sh", "-c", "mount -t tmpfs none /dev/shm && ip link add cable type veth"]
    refused = subprocess.run(trial, capture_output=True, text=True)
    if refused.returncode != 0:
        pytest.skip(f"this machine allows no network namespaces: {refused.stderr.strip()}")
    image = REPOSITORY / "docs" / "images" / "annotated.png"
    command = [*ALONE, sys.executable, "-W", "ignore", str(PROGRAM)]
    run = subprocess.run(
        [*command, str(tmp_path_factory.mktemp("watched")), str(image)],
        env=environment(DOMAIN) | SUPPORT_PATH,
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert run.returncode == 0, run.stderr
    result: dict[str, dict[str, list[str]]] = json.loads(run.stdout)
    return result


@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("command", "packets", "files"),
    [
        pytest.param("nodes", [], [COMPILED, LOG, LOG], id="detector and camera"),
        pytest.param("detect_bag", [], [COMPILED], id="detect_bag"),
        pytest.param("openvino", [], [COMPILED], id="detect_bag in OpenVINO"),
        pytest.param("evaluate", [], [FONTS, COMPILED], id="evaluate"),
        pytest.param("convert", [], [], id="convert"),
        pytest.param("fetch_weights", ["look-up of weights.test"], [], id="fetch_weights"),
    ],
)
def test_a_command_sends_and_writes_what_the_page_on_security_says(
    told: dict[str, dict[str, list[str]]], command: str, packets: list[str], files: list[str]
) -> None:
    assert told[command]["packets"] == packets
    assert len(told[command]["files"]) == len(files), told[command]["files"]
    for file, pattern in zip(told[command]["files"], files, strict=True):
        assert re.fullmatch(pattern, file), told[command]["files"]


@pytest.mark.timeout(600)
def test_a_connection_and_files_would_have_been_recorded(told: dict[str, dict[str, list[str]]]) -> None:
    assert told["control"]["packets"] == ["TCP to 192.0.2.1:80"]
    assert told["control"]["files"] == [f"{folder}/control" for folder in sorted(FOLDERS.values())]
