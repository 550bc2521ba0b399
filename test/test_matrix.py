"""What `make test-matrix` runs, which Pythons it finds, and which folders may be an environment."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY

from tools.matrix import COMBINATIONS, Combination, find_python, main, run_all

pytestmark = pytest.mark.long

MAKEFILE = REPOSITORY / "Makefile"
OWN = "{}.{}".format(*sys.version_info)


def make(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["make", *words], cwd=REPOSITORY, capture_output=True, text=True, check=False)


def program(path: Path, script: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def machine(home: Path) -> dict[str, str]:
    """A machine whose `python3.12` on PATH is pyenv's script, and whose pyenv has 3.12."""
    program(home / "shims" / "python3.12", "echo 'pyenv: python3.12: command not found' >&2; exit 127")
    program(home / ".pyenv" / "versions" / "3.12.1" / "bin" / "python3.12", "echo 3.12")
    program(home / "bin" / "python3.10", "echo 3.10")
    program(home / "bin" / "python3.13", "echo 3.9")
    return {"HOME": str(home), "PATH": f"{home / 'shims'}:{home / 'bin'}"}


@pytest.mark.parametrize(
    ("version", "found"),
    [
        pytest.param("3.10", "bin/python3.10", id="on PATH"),
        pytest.param("3.11", None, id="nowhere"),
        pytest.param("3.12", ".pyenv/versions/3.12.1/bin/python3.12", id="only in pyenv"),
        pytest.param("3.13", None, id="another version behind the name"),
    ],
)
def test_a_python_is_found_where_it_runs(version: str, found: str | None, tmp_path: Path) -> None:
    assert find_python(version, machine(tmp_path)) == (found and str(tmp_path / found))


def test_a_python_that_is_asked_for_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--find", OWN]) == 0
    interpreter = capsys.readouterr().out.strip()
    version = subprocess.run([interpreter, "--version"], capture_output=True, text=True, check=True)
    assert version.stdout.startswith(f"Python {OWN}.")
    assert main(["--find", "2.9"]) == 1
    assert "no Python 2.9" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("statuses", "found", "code", "said"),
    [
        pytest.param([0, 0], {"3.10", "3.12"}, 0, ["passed", "passed"], id="all pass"),
        pytest.param([2, 0], {"3.10", "3.12"}, 1, ["failed", "passed"], id="the first fails"),
        pytest.param([0], {"3.12"}, 0, ["left out: no Python 3.10", "passed"], id="one is missing"),
        pytest.param([], set(), 1, ["no Python 3.10", "no Python 3.12"], id="none is there"),
    ],
)
def test_every_combination_runs_and_the_table_says_how_it_ended(
    statuses: list[int], found: set[str], code: int, said: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    left = list(statuses)

    def run(command: Sequence[str]) -> int:
        assert command[:2] == ["make", "test"]
        return left.pop(0)

    combinations = [Combination("3.10", "tested"), Combination("3.12", "apt")]
    finds = {version: f"/python{version}" for version in found}
    assert run_all(combinations, run, find=finds.get, clock=lambda: 0.0) == code
    assert left == []
    table = capsys.readouterr().out.splitlines()[-2:]
    assert [line.split()[0] for line in table] == ["3.10-tested", "3.12-apt"]
    assert all(outcome in line for outcome, line in zip(said, table, strict=True))


def environments() -> list[str]:
    """The folder of each combination, as `make` itself names it."""
    question = ["shown", "--eval", "shown:;@echo '$(VENV)'"]
    return [
        make(*question, *combination.make(sys.executable)[2:]).stdout.strip() for combination in COMBINATIONS
    ]


def test_no_two_combinations_share_an_environment() -> None:
    names = environments()
    assert len(set(names)) == len(COMBINATIONS)
    assert {".venv-apt", ".venv-kilted"} < set(names)
    assert ".venv" in names or OWN not in {each.python for each in COMBINATIONS}


def test_every_set_of_the_makefile_is_in_the_matrix() -> None:
    sets = re.findall(r"\$\(SET\),(\w+)\)", MAKEFILE.read_text())
    assert len(sets) == 3
    assert {combination.package_set for combination in COMBINATIONS} == set(sets)


@pytest.mark.parametrize("folder", ["venv", "/", "..", ".venvs", ".venv-3.12/bin", ".venv-a .venv-b", ""])
def test_a_folder_that_may_hold_something_else_is_refused(folder: str) -> None:
    refused = make("--dry-run", "test", f"VENV={folder}")
    assert refused.returncode == 2
    assert "expected a folder here whose name begins with .venv-" in refused.stderr
    assert refused.stdout == ""


def test_an_unknown_set_is_refused_with_the_known_ones() -> None:
    refused = make("SET=humble")
    assert refused.returncode == 2
    assert all(f"'{name}'" in refused.stderr for name in ("tested", "apt", "kilted"))
