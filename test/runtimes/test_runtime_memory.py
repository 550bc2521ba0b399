"""What a runtime takes: the memory that is computed before it is loaded, no more threads, no telemetry."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.checkpoint_builder import SMALL
from support.colcon_workspace import SUPPORT_PATH
from support.random_model import random_model
from support.runtime_names import COMPILED_RUNTIMES, EVERY_RUNTIME
from support.started import printed_by

from benchmark.process_memory import forget_peak, peak_resident_mb, resident_mb
from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.cost import cost_of
from yolov5_lifecycle.runtimes.registry import load_runtime

MAX_RATIO = 1.9 if sys.version_info < (3, 11) else 1.6
"""Of the measured memory to the computed one: there are also the pixels, the engine and its threads. The last
ONNX Runtime for Python 3.10 (1.23) takes 1.8, later ones 1.45.
"""
SIDE_PX = 640


def _layer(kind: str, *args: int, sources: tuple[int, ...] = (-1,)) -> Layer:
    return Layer(sources, 1, kind, args)


LARGE_FEATURES: Architecture = dataclasses.replace(
    SMALL,
    classes=1,
    anchors_px=(((8.0, 8.0), (16.0, 16.0), (32.0, 32.0)),),
    strides=(8,),
    layers=(
        _layer("Conv", 200, 3, 1),
        *[_layer("Conv", 200, 1, 1, sources=(0,))] * 8,
        _layer("Concat", sources=(1, 2, 3, 4)),
        _layer("Conv", 16, 3, 8),
        _layer("Detect", sources=(10,)),
    ),
)
"""Nearly all its memory is features, 424 MB."""


def grown_mb(runtime: str) -> float:
    """By how much the peak memory of this process exceeds that before the network was loaded."""
    model = random_model(0, LARGE_FEATURES)
    before_mb = resident_mb(os.getpid())
    forget_peak()
    loaded = load_runtime(model, runtime, device="cpu", precision="fp32")
    for _ in range(3):
        loaded(np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8), "rgb", 0.99)
    return peak_resident_mb(os.getpid()) - before_mb


@pytest.mark.long
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_a_runtime_needs_the_memory_that_was_computed_before(runtime: str, tmp_path: Path) -> None:
    """In a process of its own, where no free memory of earlier tests is used."""
    measured = subprocess.run(
        [sys.executable, __file__, runtime],
        env=os.environ | SUPPORT_PATH | {"XDG_CACHE_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    computed_mb = cost_of(LARGE_FEATURES, (SIDE_PX, SIDE_PX)).memory_bytes / (1 << 20)
    assert 0.8 < float(measured.stdout) / computed_mb < MAX_RATIO


def test_products_of_matrices_start_no_threads_that_would_compete_with_the_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    program = (
        "import os\n"
        "from yolov5_lifecycle.process.environment import prepare_environment\n"
        "prepare_environment()\n"
        "import numpy as np\n"
        "np.ones((512, 512), np.float32) @ np.ones((512, 512), np.float32)\n"
        "print(len(os.listdir('/proc/self/task')))"
    )
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert printed_by(program) == "1\n"


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
@pytest.mark.parametrize("runtime", COMPILED_RUNTIMES)
def test_a_runtime_is_imported_without_telemetry(runtime: str, tmp_path: Path) -> None:
    """It leaves the home folder alone and looks up no host."""
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


if __name__ == "__main__":
    sys.stdout.write(f"{grown_mb(sys.argv[1])}\n")
