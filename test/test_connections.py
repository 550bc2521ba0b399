"""The commands open no connections but those of ROS, and write only the files that docs/security.md names."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY, SUPPORT, SUPPORT_PATH
from support.detector_process import environment
from support.watched_processes import DOMAIN, FOLDERS

PROGRAM = SUPPORT / "watched_processes.py"
ALONE = ["unshare", "--map-root-user", "--net", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
COMPILED = r"cache/yolov5_lifecycle/compiled/[0-9a-f]{64}"
LOG = r"log/[^/]+\.log"
EXPECTED = {
    "nodes": ([], [COMPILED, LOG, LOG]),
    "detect_bag": ([], [COMPILED]),
    "openvino": ([], [COMPILED]),
    "evaluate": ([], [COMPILED]),
    "convert": ([], []),
    "fetch_weights": (["look-up of weights.test"], []),
    "control": (["TCP to 192.0.2.1:80"], [f"{folder}/control" for folder in sorted(FOLDERS.values())]),
}
"""By command, the packets and the files; the control shows that either would have been recorded."""


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_command_sends_and_writes_what_the_page_on_security_says(tmp_path: Path) -> None:
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
    run = subprocess.run(
        [*ALONE, sys.executable, "-W", "ignore", str(PROGRAM), str(tmp_path), str(image)],
        env=environment(DOMAIN) | SUPPORT_PATH,
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert run.returncode == 0, run.stderr
    told: dict[str, dict[str, list[str]]] = json.loads(run.stdout)
    assert {name: one["packets"] for name, one in told.items()} == {
        name: packets for name, (packets, _) in EXPECTED.items()
    }
    for name, (_, patterns) in EXPECTED.items():
        files = told[name]["files"]
        assert len(files) == len(patterns), (name, files)
        assert all(map(re.fullmatch, patterns, files)), (name, files)
