"""The forward pass in fp32, int8 and bf16 on this processor, for networks of several sizes.

python -m benchmark.precisions [--sizes n s m] [--size 640x480] [--quick]
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmark.models import untrained_weights
from benchmark.report import Figures, Goal, Program, measured_ms, quick, row, size_hw
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import fuse
from yolov5_lifecycle.quantization.activation_ranges import activations
from yolov5_lifecycle.runtimes.processor import abilities, has_bf16
from yolov5_lifecycle.runtimes.quantization import Quantization
from yolov5_lifecycle.runtimes.registry import COARSE_RUNTIME, installed_runtimes, load_runtime

SIZES = ("n", "s", "m")
INT8 = f"int8 in {COARSE_RUNTIME}"
_FP32 = "fp32 in "
_NOTHING_FOUND = 1.0
_MIN_SPEEDUP = 1.5


def calls(model: Model, size_hw: tuple[int, int]) -> Mapping[str, Callable[[], object]]:
    """The forward pass in each precision that this processor has, by name."""
    frame = np.random.default_rng(0).integers(0, 256, (*size_hw, 3), np.uint8)
    quantization = of_frame(model, size_hw)
    wanted = [(name, "fp32") for name in installed_runtimes() if name != "torch"]
    wanted.append((COARSE_RUNTIME, "int8"))
    if has_bf16(abilities()):
        wanted.append((COARSE_RUNTIME, "bf16"))
    runtimes = {
        f"{precision} in {name}": load_runtime(
            model, name, device="cpu", precision=precision, quantization=quantization
        )
        for name, precision in wanted
    }
    return {name: partial(runtime, frame, "rgb", _NOTHING_FOUND) for name, runtime in runtimes.items()}


def of_frame(model: Model, size_hw: tuple[int, int]) -> Quantization:
    """All convolutions in int8, with ranges of one random frame, which do not affect the time."""
    frame = torch.rand((1, model.architecture.image_channels, *size_hw))
    read = activations(fuse(model.network()), [frame], progress=lambda _: None)
    return Quantization.of(read)


def goal(size: str, taken_ms: Mapping[str, Sequence[float]]) -> Goal:
    """Speedup of int8 over the fastest fp32."""
    medians_ms = {name: statistics.median(times_ms) for name, times_ms in taken_ms.items()}
    fp32_ms = min(median for name, median in medians_ms.items() if name.startswith(_FP32))
    return Goal(f"yolov5{size}: fp32 / int8", 0, fp32_ms / medians_ms[INT8], False, _MIN_SPEEDUP)


def measured(options: argparse.Namespace, folder: Path) -> Figures:
    """The networks of all sizes."""
    rows, goals = [], []
    for size in options.sizes:
        model = load_weights(untrained_weights(size, folder)).model
        taken_ms = measured_ms(calls(model, options.size), turns=5 if options.quick else 40)
        rows += [row(f"yolov5{size}", name, 0, times_ms) for name, times_ms in taken_ms.items()]
        goals.append(goal(size, taken_ms))
    print(f"processor: {', '.join(abilities()) or 'nothing special'}")
    return rows, goals


PROGRAM = Program(
    "precisions",
    __doc__,
    measured,
    {
        "--quick": quick("fewer rounds"),
        "--sizes": {"nargs": "+", "choices": SIZES, "default": SIZES, "help": "of the networks"},
        "--size": {"type": size_hw, "default": "640x480", "help": "width x height of the input"},
    },
)


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
