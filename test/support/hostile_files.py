"""All hostile and wrong weights files, and what becomes of each."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from support import hostile_costs, hostile_onnx
from support.colcon_workspace import REPOSITORY, SUPPORT
from support.hostile_archives import ARCHIVES, FOREIGN_FILES, valid
from support.hostile_gadgets import GADGETS, MARKER
from support.hostile_pickles import BOMBS, TENSORS
from support.hostile_safetensors import FILES
from support.special_files import SPECIAL
from support.wrong_models import MODELS

Table = Mapping[str, tuple[Callable[[], bytes], str]]
MAX_GROWN_MB = 100
"""The memory of a process may grow by this much while it reads a file; some ask for 16 TB."""
CHECKPOINTS: Table = {
    f"{kind}: {name}": case
    for kind, table in {
        "gadget": GADGETS, "bomb": BOMBS, "tensor": TENSORS, "foreign": FOREIGN_FILES,
        "archive": ARCHIVES, "model": MODELS, "cost": hostile_costs.CHECKPOINTS,
    }.items()
    for name, case in table.items()
}  # fmt: skip
SAFETENSORS: Table = {
    f"safetensors: {name}": case for name, case in {**FILES, **hostile_costs.SAFETENSORS}.items()
}
EXPORTS: Table = {f"onnx: {name}": case for name, case in hostile_onnx.FILES.items()}
TOLD = {name: told for name, (_, told) in {**CHECKPOINTS, **SAFETENSORS, **EXPORTS}.items()} | {
    f"special: {name}": told for name, (_, told) in SPECIAL.items()
}


class Answer(NamedTuple):
    name: str
    outcome: str
    message: str
    cpu_s: float
    grown_mb: float
    events: list[str]

    @property
    def is_refused(self) -> bool:
        return self.outcome in ("WeightsError", "UncheckedError")


def write_all(folder: Path) -> dict[str, str]:
    """All files, and which case each file name stands for."""
    cases = write_tables(folder, {".pt": CHECKPOINTS, ".safetensors": SAFETENSORS, ".onnx": EXPORTS})
    for index, (name, (make_at, _)) in enumerate(SPECIAL.items(), start=len(cases)):
        cases[make_at(folder, f"{index:03}").name] = f"special: {name}"
    return cases


def write_tables(folder: Path, tables: Mapping[str, Table]) -> dict[str, str]:
    """The files of tables by the end of their names, and which case each file name stands for."""
    cases = {}
    files = chain.from_iterable(
        ((suffix, case) for case in table.items()) for suffix, table in tables.items()
    )
    for index, (suffix, (name, (make, _))) in enumerate(files):
        file = folder / f"{index:03}{suffix}"
        file.write_bytes(make())
        cases[file.name] = name
    return cases


def read_all(folder: Path, write: Callable[[Path], dict[str, str]] = write_all) -> dict[str, Answer]:
    """What became of every file, by case; all are read by one process that has a limit to its memory."""
    files, workplace = folder / "files", folder / "workplace"
    files.mkdir()
    workplace.mkdir()
    cases = write(files)
    (folder / "valid.pt").write_bytes(valid())
    (workplace / f"{MARKER}.py").write_text(f"open({str(workplace / 'imported')!r}, 'w').close()")
    reader = subprocess.run(
        [sys.executable, SUPPORT / "hostile_reader.py", folder / "valid.pt", files],
        cwd=workplace,
        env=os.environ | {"PYTHONPATH": f"{workplace}:{REPOSITORY}"},
        capture_output=True,
        text=True,
    )
    assert (reader.returncode, reader.stderr) == (0, "")
    found = [Answer(**json.loads(line)) for line in reader.stdout.splitlines()]
    return {cases[answer.name]: answer for answer in found}
