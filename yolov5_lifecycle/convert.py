"""Command `convert IN.pt OUT.safetensors`: YOLOv5's checkpoint to a file that nothing can hide in."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from yolov5_lifecycle.model import Model, WeightsError
from yolov5_lifecycle.network import Network
from yolov5_lifecycle.safetensors_file import write_safetensors
from yolov5_lifecycle.weights import WeightsFile, load_weights


def convert(source: Path, target: Path, *, overwrite: bool) -> WeightsFile:
    """Write the model in `source` to `target` and give what can be read back from there.

    Raises WeightsError, and OSError when `target` cannot be written.
    """
    if target.suffix != ".safetensors":
        raise WeightsError(f"{target}: expected a name that ends in .safetensors.")
    if target.exists() and not overwrite:
        raise WeightsError(f"{target} exists; give --force to replace it.")
    if not target.parent.is_dir():
        raise WeightsError(f"{target.parent}: there is no such folder; make it first.")
    write_safetensors(load_weights(source).model, target)
    return load_weights(target)


def report(written: WeightsFile) -> str:
    """What a user wants to know of the file, one fact a line."""
    names = written.model.class_names
    return (
        f"{written.path}\n"
        f"classes     {len(names)}: {', '.join(names)}\n"
        f"parameters  {_parameters(written.model):,}\n"
        f"sha256      {written.sha256}\n"
    )


def _parameters(model: Model) -> int:
    with torch.device("meta"):
        return sum(parameter.numel() for parameter in Network(model.architecture).parameters())


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="convert",
        description="Convert a YOLOv5 checkpoint (v6 or v7) to .safetensors, without running what is in it.",
    )
    parser.add_argument("source", type=Path, metavar="IN.pt")
    parser.add_argument("target", type=Path, metavar="OUT.safetensors")
    parser.add_argument("--force", action="store_true", help="replace OUT.safetensors if it is there")
    arguments = parser.parse_args(argv)
    try:
        written = convert(arguments.source, arguments.target, overwrite=arguments.force)
    except (WeightsError, OSError) as error:
        sys.stderr.write(f"convert: {error}\n")
        return 1
    sys.stdout.write(report(written))
    return 0
