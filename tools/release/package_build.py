"""Builds the package: source archive and wheel."""

from __future__ import annotations

import sys
import tarfile
from collections.abc import Mapping
from pathlib import Path

from tools.release.program import run_quietly

NAME = "yolov5_lifecycle"


def build_package(source: Path, output: Path, variables: Mapping[str, str]) -> list[Path]:
    """Build source archive and wheel from the folder `source` into the folder `output`; returns both files.

    Older ones in `output` are removed. `variables` are added to the environment. Needs the packages of
    requirements/release.txt, and no network. Raises CalledProcessError.
    """
    output.mkdir(parents=True, exist_ok=True)
    for older in _built(output):
        older.unlink()
    run_quietly([sys.executable, "-m", "build", "--no-isolation", "--outdir", output, source], variables)
    return _built(output)


def _built(folder: Path) -> list[Path]:
    return [*folder.glob(f"{NAME}-*.tar.gz"), *folder.glob(f"{NAME}-*.whl")]


def archived_files(archive: Path) -> set[str]:
    """The paths of the files in a source archive, relative to its one folder."""
    with tarfile.open(archive) as members:
        return {member.name.partition("/")[2] for member in members if member.isfile()}


def content_problems(archived: set[str], committed: set[str]) -> list[str]:
    """Why a source archive of the files `archived` is not one of the files `committed`, one line each."""
    generated = {file for file in archived if file == "PKG-INFO" or file.startswith(f"{NAME}.egg-info/")}
    return [
        *(
            f"{file}: committed, but not in the source archive; add it to MANIFEST.in"
            for file in sorted(committed - archived)
        ),
        *(
            f"{file}: in the source archive, but not committed"
            for file in sorted(archived - committed - generated)
        ),
    ]
