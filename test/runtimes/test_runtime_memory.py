"""A runtime needs about the memory that is computed for its network before it is loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import measured_runtime
from support.colcon_workspace import SUPPORT_PATH
from support.measured_runtime import LARGE_FEATURES, SIDE_PX
from support.runtime_names import EVERY_RUNTIME

from yolov5_lifecycle.models.cost import cost_of

MAX_RATIO = 1.9 if sys.version_info < (3, 11) else 1.6
"""Of the measured memory to the computed one: there are also the pixels, the engine and its threads. The last
ONNX Runtime for Python 3.10 (1.23) takes 1.8, later ones 1.45.
"""


@pytest.mark.long
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_a_runtime_needs_the_memory_that_was_computed_before(runtime: str, tmp_path: Path) -> None:
    measured = subprocess.run(
        [sys.executable, measured_runtime.__file__, runtime],
        env=os.environ | SUPPORT_PATH | {"XDG_CACHE_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    computed_mb = cost_of(LARGE_FEATURES, (SIDE_PX, SIDE_PX)).memory_bytes / (1 << 20)
    assert 0.8 < float(measured.stdout) / computed_mb < MAX_RATIO
