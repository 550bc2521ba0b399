"""Names of runtimes to run a test with; those that are not installed are skipped."""

from __future__ import annotations

import pytest

from yolov5_lifecycle.runtimes.registry import REQUIREMENTS, installed_runtimes

_INSTALLED = installed_runtimes()
EVERY_RUNTIME = [
    pytest.param(
        name,
        marks=pytest.mark.skipif(name not in _INSTALLED, reason=f"no {name}: make install"),
    )
    for name in REQUIREMENTS
]
COMPILED_RUNTIMES = EVERY_RUNTIME[1:]
"""All but torch."""
