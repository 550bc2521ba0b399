"""Importing a runtime leaves the home folder alone and looks up no host."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from yolov5_lifecycle.runtimes.registry import installed_runtimes

IMPORT = """
import sys
seen = []
names = ("socket.getaddrinfo", "socket.gethostbyname", "socket.connect")
sys.addaudithook(lambda event, args: seen.append((event, args)) if event in names else None)
import yolov5_lifecycle.runtimes.{runtime}_runtime
import threading
for thread in threading.enumerate():
    if thread is not threading.current_thread() and not thread.daemon:
        thread.join()
sys.exit(repr(seen) if seen else 0)
"""


@pytest.mark.long
@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
def test_a_runtime_is_imported_without_telemetry(runtime: str, tmp_path: Path) -> None:
    if runtime not in installed_runtimes():
        pytest.skip(f"no {runtime}: make install")
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    imported = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", IMPORT.format(runtime=runtime)],
        env=variables | {"HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert imported.returncode == 0, imported.stderr
    assert list(tmp_path.rglob("*")) == []
