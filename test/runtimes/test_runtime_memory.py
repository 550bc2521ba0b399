"""What a runtime takes: the memory that is computed before, given back on close; no threads, no telemetry."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.checkpoint_builder import SMALL
from support.colcon_workspace import SUPPORT_PATH
from support.random_model import CLASS_NAMES, random_frame, random_model
from support.runtime_names import COMPILED_RUNTIMES, EVERY_RUNTIME
from support.started import printed_by

from benchmark.process_memory import forget_peak, peak_resident_mb, resident_mb
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.architecture import SIZES, Architecture, Layer
from yolov5_lifecycle.models.cost import cost_of
from yolov5_lifecycle.process.memory import release_unused_memory
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


def kept_mb(runtime: str) -> float:
    """By how much the memory of this process grows while a network is loaded and closed eight times.

    The engines keep some of the first few.
    """
    model = random_model(0, dataclasses.replace(SIZES["n"], classes=len(CLASS_NAMES)))
    image = ColourImage(random_frame(240, 320), "rgb")
    used_mb = []
    for _ in range(12):
        detector = load_detector(model, runtime=runtime, image_size=320)
        detector.detect(image, Selection())
        detector.close()
        release_unused_memory()
        used_mb.append(resident_mb(os.getpid()))
    return min(used_mb[-3:]) - used_mb[3]


def in_new_process(measure: Callable[[str], float], runtime: str, tmp_path: Path) -> float:
    """A process that has run tests has free memory from them, and heaps that grow by leaps."""
    module, name = f"runtimes.{Path(__file__).stem}", measure.__name__
    program = f"from {module} import {name}; print({name}({runtime!r}))"
    return float(printed_by(program, variables=SUPPORT_PATH | {"XDG_CACHE_HOME": str(tmp_path)}))


@pytest.mark.long
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_a_runtime_needs_the_memory_that_was_computed_before(runtime: str, tmp_path: Path) -> None:
    computed_mb = cost_of(LARGE_FEATURES, (SIDE_PX, SIDE_PX)).memory_bytes / (1 << 20)
    assert 0.8 < in_new_process(grown_mb, runtime, tmp_path) / computed_mb < MAX_RATIO


@pytest.mark.long
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_loading_and_closing_many_times_keeps_no_memory(runtime: str, tmp_path: Path) -> None:
    assert in_new_process(kept_mb, runtime, tmp_path) < 7  # the weights alone are 7.5 MB a time


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
