"""What detectors are measured with: weights and an image.

The process that measures memory must not import torch, whose libraries would count as shared.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path


def materials(image_hw: tuple[int, int], folder: Path) -> tuple[Path, Path]:
    """Untrained weights and an image in `folder`, created in a process that exits."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_made, image_hw, folder).result()


def _made(image_hw: tuple[int, int], folder: Path) -> tuple[Path, Path]:
    from benchmark.models import untrained_weights
    from benchmark.node import image_file

    return untrained_weights("n", folder), image_file(image_hw, folder)
