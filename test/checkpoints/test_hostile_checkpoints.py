"""Hostile and wrong weights files are refused, each with its own message, and nothing in them is run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY, SUPPORT
from support.hostile_archives import valid
from support.hostile_files import (
    MAX_GROWN_MB,
    TOLD,
    Answer,
    read_all,
)
from support.hostile_gadgets import MARKER

from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint

MAX_CPU_S = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture(scope="module")
def answers(folder: Path) -> dict[str, Answer]:
    return read_all(folder)


def test_a_valid_file_is_what_the_others_differ_from() -> None:
    assert read_checkpoint(valid()).class_names == ("cat", "dog", "cow")


@pytest.mark.end_to_end
@pytest.mark.parametrize("case", TOLD)
def test_the_file_is_refused_in_its_own_words(case: str, answers: dict[str, Answer]) -> None:
    answer = answers[case]
    assert answer.is_refused, answer
    assert TOLD[case] in answer.message
    assert answer.name in answer.message
    assert answer.message.isprintable()
    assert len(answer.message) < 1000


@pytest.mark.end_to_end
@pytest.mark.parametrize("case", TOLD)
def test_nothing_in_the_file_is_run(case: str, answers: dict[str, Answer], folder: Path) -> None:
    assert answers[case].events == []
    assert [file.name for file in (folder / "workplace").iterdir()] == [f"{MARKER}.py"]


@pytest.mark.long
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
        env=os.environ | {"PYTHONPATH": f"{workplace}:{SUPPORT}:{REPOSITORY}"},
        capture_output=True,
        text=True,
        check=True,
    )
    trace = workplace / "imported"
    assert trace.exists()
    trace.unlink()
    assert "os.system" in seen.stdout


AFTER_MAPPING_MUCH = """
import mmap, sys
mapped = mmap.mmap(-1, 4 << 30, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=0)
"""
READ_THEN_FILL = """
from pathlib import Path
import hostile_reader
hostile_reader.main(*map(Path, sys.argv[1:]))
try:
    bytes((hostile_reader.MEMORY_MB + 1) << 20)
except MemoryError:
    print("limited")
"""


@pytest.mark.long
def test_only_memory_mapped_after_the_imports_is_limited(tmp_path: Path) -> None:
    """torch for CUDA maps 3.2 GB when it is imported; the limit holds nevertheless."""
    weights, files = tmp_path / "valid.pt", tmp_path / "files"
    weights.write_bytes(valid())
    files.mkdir()
    (files / "same.pt").write_bytes(valid())
    run = subprocess.run(
        [sys.executable, "-c", AFTER_MAPPING_MUCH + READ_THEN_FILL, weights, files],
        env=os.environ | {"PYTHONPATH": f"{SUPPORT}:{REPOSITORY}"},
        capture_output=True,
        text=True,
        check=False,
    )
    answer, told = run.stdout.splitlines() or ("", run.stderr)
    assert ('"outcome": "accepted"' in answer, told) == (True, "limited"), run.stderr


@pytest.mark.end_to_end
def test_no_file_takes_up_the_memory_or_the_time(answers: dict[str, Answer]) -> None:
    assert answers.keys() == TOLD.keys()
    slowest = max(answers.values(), key=lambda answer: answer.cpu_s)
    assert slowest.cpu_s < MAX_CPU_S, slowest
    largest = max(answers.values(), key=lambda answer: answer.grown_mb)
    assert largest.grown_mb < MAX_GROWN_MB, largest


@pytest.mark.end_to_end
def test_most_refusals_differ(answers: dict[str, Answer]) -> None:
    messages = {answer.message.partition(answer.name)[2] for answer in answers.values()}
    assert len(messages) > 0.8 * len(answers)
