"""The mutation tester: which changes it makes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY

from tools.mutants.folders import PACKAGE, TESTS, files_of_tests

pytestmark = pytest.mark.long

PATIENCE_S = 60.0


@pytest.mark.parametrize("folder", TESTS)
def test_every_folder_has_modules_and_tests(folder: str) -> None:
    assert list((REPOSITORY / PACKAGE / folder).glob("*.py"))
    files = files_of_tests(folder)
    assert files
    assert all((REPOSITORY / file).is_file() for file in files)


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        pytest.param("", [], id="nothing"),
        pytest.param("LIMIT = 3", ["LIMIT: LIMIT = 3 => LIMIT = None", "LIMIT: 3 => 4"], id="a constant"),
        pytest.param('def f():\n    """Text of a function."""', [], id="a docstring"),
        pytest.param("def f(x: int | None) -> int: ...", [], id="annotations"),
        pytest.param('def f():\n    raise ValueError(f"{1 + 1} is wrong")', [], id="an error"),
        pytest.param('def f(log):\n    log.warning("beware", 1)', [], id="a log entry"),
        pytest.param('def f():\n    return "told to people"', [], id="a text"),
        pytest.param('def f():\n    return "key"', ['f: "key" => "XXkeyXX"'], id="a key"),
        pytest.param("Alias = list[int]", [], id="the name of a type"),
        pytest.param(
            "def f(rows):\n    return rows.reshape(-1)",
            ["f: rows.reshape(-1) => rows.reshape(None)"],
            id="reshape",
        ),
        pytest.param(
            "class A:\n    @property\n    def b(self):\n        return self.c < 1",
            ["A.b: < 1 => <= 1", "A.b: 1 => 2"],
            id="a property",
        ),
        pytest.param(
            "def f(a):\n    return a + a + 1\n\n\ndef g(a):\n    return a",
            ["f: a + a + 1 => a + a - 1", "f: a + a => a - a", "f: 1 => 2"],
            id="a sum",
        ),
        pytest.param(
            "def f(a):\n    a(1)\n    a(1)",
            ["f: a(1) => a(None)", "f: 1 => 2", "f: a(1) => a(None) (2)", "f: 1 => 2 (2)"],
            id="twice the same",
        ),
    ],
)
def test_only_what_a_test_could_notice_is_changed(code: str, expected: list[str]) -> None:
    pytest.importorskip("mutmut", reason="`make mutants` installs it")
    from tools.mutants.mutant import mutants_in

    found = list(mutants_in("a.py", code))
    assert [mutant.name.removeprefix("a.py ") for mutant in found] == expected
    assert all(mutant.code() != code and mutant.is_python() for mutant in found)


def test_a_sample_stays_the_same_when_other_code_is_added() -> None:
    pytest.importorskip("mutmut", reason="`make mutants` installs it")
    from tools.mutants.mutant import mutants_in, sampled

    lines = [f"LIMIT_{number} = {number}\n" for number in range(100)]
    before = {mutant.name for mutant in sampled(mutants_in("a.py", "".join(lines)), 20, 0)}
    after = {mutant.name for mutant in sampled(mutants_in("a.py", "OTHER = 1\n" + "".join(lines)), 20, 0)}
    another = {mutant.name for mutant in sampled(mutants_in("a.py", "".join(lines)), 20, 1)}
    assert len(before) == 20
    assert len(before & after) >= 18
    assert len(before & another) < 18


HANGS = """
import threading

def test_waits_for_a_thread_that_fails():
    done = threading.Event()
    threading.Thread(target=lambda: 1 / 0, daemon=True).start()
    done.wait()
"""


def test_an_error_that_no_thread_handles_ends_the_trial(tmp_path: Path) -> None:
    file = tmp_path / "test_hangs.py"
    file.write_text(HANGS)
    question = json.dumps({"tests": [str(file)], "measured": "", "limit_s": PATIENCE_S})
    answer = subprocess.run(
        [sys.executable, "-m", "tools.mutants.worker"],
        cwd=REPOSITORY,
        input=question + "\n",
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(answer.stdout)["code"] == pytest.ExitCode.TESTS_FAILED
