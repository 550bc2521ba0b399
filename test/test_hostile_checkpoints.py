"""Hostile and wrong weights files are refused, each in its own words, and nothing in them is run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import pytest
from colcon_workspace import REPOSITORY
from hostile_archives import ARCHIVES, FOREIGN_FILES, valid
from hostile_pickles import BOMBS, GADGETS, MARKER, TENSORS
from hostile_safetensors import FILES
from special_files import SPECIAL
from wrong_models import MODELS

from yolov5_lifecycle.checkpoint import read_checkpoint

Table = Mapping[str, tuple[Callable[[], bytes], str]]
MAX_SECONDS = 20
MAX_GROWN_MB = 100
"""The memory of a process may grow by this much while it reads a file; some ask for 16 TB."""

CHECKPOINTS: Table = {
    f"{kind}: {name}": case
    for kind, table in {
        "gadget": GADGETS, "bomb": BOMBS, "tensor": TENSORS, "foreign": FOREIGN_FILES,
        "archive": ARCHIVES, "model": MODELS,
    }.items()
    for name, case in table.items()
}  # fmt: skip
SAFETENSORS: Table = {f"safetensors: {name}": case for name, case in FILES.items()}
TOLD = {name: told for name, (_, told) in chain(CHECKPOINTS.items(), SAFETENSORS.items())} | {
    f"special: {name}": told for name, (_, told) in SPECIAL.items()
}


class Answer(NamedTuple):
    name: str
    outcome: str
    message: str
    seconds: float
    grown_mb: float
    events: list[str]

    @property
    def is_refused(self) -> bool:
        return self.outcome in ("WeightsError", "UncheckedError")


def write_all(folder: Path) -> dict[str, str]:
    """All files, and which case each file name stands for."""
    cases = {}
    for index, (name, (make, _)) in enumerate(chain(CHECKPOINTS.items(), SAFETENSORS.items())):
        file = folder / f"{index:03}{'.pt' if name in CHECKPOINTS else '.safetensors'}"
        file.write_bytes(make())
        cases[file.name] = name
    for index, (name, (make_at, _)) in enumerate(SPECIAL.items(), start=len(cases)):
        cases[make_at(folder, f"{index:03}").name] = f"special: {name}"
    return cases


def read_all(folder: Path) -> dict[str, Answer]:
    """What became of every file, by case; all are read by one process that has a limit to its memory."""
    files, workplace = folder / "files", folder / "workplace"
    files.mkdir()
    workplace.mkdir()
    cases = write_all(files)
    (folder / "valid.pt").write_bytes(valid())
    (workplace / f"{MARKER}.py").write_text(f"open({str(workplace / 'imported')!r}, 'w').close()")
    reader = subprocess.run(
        [sys.executable, Path(__file__).with_name("hostile_reader.py"), folder / "valid.pt", files],
        cwd=workplace,
        env=os.environ | {"PYTHONPATH": f"{workplace}:{REPOSITORY}"},
        capture_output=True,
        text=True,
    )
    assert (reader.returncode, reader.stderr) == (0, "")
    found = [Answer(**json.loads(line)) for line in reader.stdout.splitlines()]
    return {cases[answer.name]: answer for answer in found}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture(scope="module")
def answers(folder: Path) -> dict[str, Answer]:
    return read_all(folder)


def test_a_valid_file_is_what_the_others_differ_from() -> None:
    assert read_checkpoint(valid()).class_names == ("cat", "dog", "cow")


@pytest.mark.parametrize("case", TOLD)
def test_the_file_is_refused_in_its_own_words(case: str, answers: dict[str, Answer]) -> None:
    answer = answers[case]
    assert answer.is_refused, answer
    assert TOLD[case] in answer.message
    assert answer.name in answer.message
    assert answer.message.isprintable()
    assert len(answer.message) < 1000


@pytest.mark.parametrize("case", TOLD)
def test_nothing_in_the_file_is_run(case: str, answers: dict[str, Answer], folder: Path) -> None:
    assert answers[case].events == []
    assert [file.name for file in (folder / "workplace").iterdir()] == [f"{MARKER}.py"]


def test_the_traces_of_a_gadget_are_seen(folder: Path, answers: dict[str, Answer]) -> None:
    """The guard of the tests above: what a gadget would do is noticed when it is done."""
    assert answers
    script = f"""
import os, sys, hostile_reader
events = []
sys.addaudithook(lambda event, _: events.append(event) if event.startswith(hostile_reader.SUSPECT) else None)
import {MARKER}
os.system("true")
print(events)
"""
    workplace = folder / "workplace"
    seen = subprocess.run(
        [sys.executable, "-B", "-c", script],
        env=os.environ | {"PYTHONPATH": f"{workplace}:{Path(__file__).parent}:{REPOSITORY}"},
        capture_output=True,
        text=True,
        check=True,
    )
    trace = workplace / "imported"
    assert trace.exists()
    trace.unlink()
    assert "os.system" in seen.stdout


def test_no_file_takes_up_the_memory_or_the_time(answers: dict[str, Answer]) -> None:
    assert answers.keys() == TOLD.keys()
    slowest = max(answers.values(), key=lambda answer: answer.seconds)
    assert slowest.seconds < MAX_SECONDS, slowest
    largest = max(answers.values(), key=lambda answer: answer.grown_mb)
    assert largest.grown_mb < MAX_GROWN_MB, largest


def test_most_refusals_differ(answers: dict[str, Answer]) -> None:
    messages = {answer.message.partition(answer.name)[2] for answer in answers.values()}
    assert len(messages) > 0.8 * len(answers)
