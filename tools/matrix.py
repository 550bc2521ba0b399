"""Runs `make test` with every supported Python and set of packages, as far as this machine has the Pythons.

`--find 3.12` only prints the path of such a Python. Needs nothing but Python itself.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
_OWN_VERSION = "{}.{}".format(*sys.version_info)
"""That of `make` without PYTHON, for which .venv is."""
Run = Callable[[Sequence[str]], int]
"""Runs a command and returns its exit status."""


@dataclass(frozen=True)
class Combination:
    """A Python, such as "3.12", and a SET of the Makefile."""

    python: str
    package_set: str

    @property
    def name(self) -> str:
        return f"{self.python}-{self.package_set}"

    def make(self, interpreter: str) -> list[str]:
        """The command that runs the tests, in an environment that no other combination uses."""
        words = ["make", "test", f"PYTHON={interpreter}", f"SET={self.package_set}"]
        is_usual = self.package_set != "tested" or self.python == _OWN_VERSION
        return words if is_usual else [*words, f"VENV=.venv-{self.python}"]


COMBINATIONS = (
    Combination("3.10", "tested"),
    Combination("3.11", "tested"),
    Combination("3.12", "tested"),
    Combination("3.13", "tested"),
    Combination("3.12", "apt"),
    Combination("3.12", "kilted"),
)


def find_python(version: str, environment: Mapping[str, str] = os.environ) -> str | None:
    """Path of a Python `version`, such as "3.12", on PATH or in pyenv's folder; None when there is none."""
    return next((path for path in _candidates(version, environment) if _is_python(path, version)), None)


def _absence(version: str) -> str:
    return f"no Python {version} on PATH or in ~/.pyenv"


def _candidates(version: str, environment: Mapping[str, str]) -> Iterator[str]:
    for folder in environment.get("PATH", "").split(os.pathsep):
        if found := shutil.which(f"python{version}", path=folder):
            yield found
    pyenv = Path(environment.get("PYENV_ROOT") or Path(environment.get("HOME", "")) / ".pyenv")
    yield from map(str, sorted(pyenv.glob(f"versions/{version}*/bin/python{version}"), reverse=True))


def _is_python(path: str, version: str) -> bool:
    """Whether the file runs and is that version: pyenv puts scripts on PATH that only say what is missing."""
    question = "import sys; print('{}.{}'.format(*sys.version_info))"
    try:
        answer = subprocess.run([path, "-c", question], capture_output=True, text=True, check=False)
    except OSError:
        return False
    return answer.stdout.strip() == version


def run_all(
    combinations: Iterable[Combination],
    run: Run,
    find: Callable[[str], str | None] = find_python,
    clock: Callable[[], float] = time.monotonic,
) -> int:
    """Run each combination, print a table of the outcomes, and return 1 if one failed or none ran, else 0."""
    rows: list[tuple[str, str]] = []
    for combination in combinations:
        interpreter = find(combination.python)
        if interpreter is None:
            rows.append((combination.name, f"left out: {_absence(combination.python)}"))
            continue
        command, began = combination.make(interpreter), clock()
        print(f"== {combination.name}: {shlex.join(command)}", flush=True)
        outcome = "failed" if run(command) else "passed"
        rows.append((combination.name, f"{outcome} in {(clock() - began) / 60:.0f} min"))
    print(*(f"{name:12} {outcome}" for name, outcome in rows), sep="\n")
    outcomes = {outcome.split()[0] for _, outcome in rows}
    return 0 if outcomes >= {"passed"} and "failed" not in outcomes else 1


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="python -m tools.matrix", description=(__doc__ or "").splitlines()[0])
    names = [combination.name for combination in COMBINATIONS]
    made.add_argument("--only", nargs="+", choices=names, default=names, help="the combinations to run")
    made.add_argument("--find", metavar="VERSION", help="print the path of such a Python, and run nothing")
    return made


def main(arguments: Sequence[str]) -> int:
    options = parser().parse_args(arguments)
    if options.find:
        found = find_python(options.find)
        print(found or _absence(options.find), file=None if found else sys.stderr)
        return 0 if found else 1
    chosen = [combination for combination in COMBINATIONS if combination.name in options.only]
    return run_all(chosen, lambda command: subprocess.run(command, cwd=REPOSITORY, check=False).returncode)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
