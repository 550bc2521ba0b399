"""The workflows for the site that hosts the repository: few rights, pinned actions, targets that exist."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.colcon_workspace import REPOSITORY

pytestmark = pytest.mark.long

WRITES = {
    ("docs", "publish"): {"contents"},
    ("image", "push"): {"packages"},
    ("image", "join"): {"attestations", "id-token", "packages"},
    ("release", "publish"): {"attestations", "id-token"},
    ("release", "announce"): {"contents"},
}
"""What a job may change; every other one only reads the repository."""
ACTIONS = {
    "actions/attest",
    "actions/checkout",
    "actions/download-artifact",
    "actions/setup-python",
    "actions/upload-artifact",
}
"""Where code of others runs in our name: a new one needs a reason, because a `run` step usually does."""
FILES = sorted((REPOSITORY / ".github" / "workflows").glob("*.yml"))


class _Loader(yaml.SafeLoader):
    """Leaves the key `on` a text, as the site does."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:bool"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile("true|false"), list("tf"))


@dataclass(frozen=True)
class Step:
    """One step of a job; `script` is empty where an action is used."""

    workflow: str
    job: str
    name: str
    script: str
    uses: str
    inputs: Mapping[str, Any]

    def __str__(self) -> str:
        return f"{self.workflow}, {self.job}: {self.name}"


def _loaded(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.load(path.read_text(), _Loader)  # a SafeLoader
    return found


WORKFLOWS = {path.stem: _loaded(path) for path in FILES}
STEPS = [
    Step(
        workflow,
        name,
        step.get("name", step.get("uses", "").partition("@")[0]),
        script=step.get("run", ""),
        uses=step.get("uses", ""),
        inputs=step.get("with", {}),
    )
    for workflow, content in WORKFLOWS.items()
    for name, job in content["jobs"].items()
    for step in job.get("steps", [])
]

JOBS = [(name, job) for name, workflow in WORKFLOWS.items() for job in workflow["jobs"]]
MACHINES = [job for job in JOBS if "runs-on" in WORKFLOWS[job[0]]["jobs"][job[1]]]
"""The jobs that are no other workflow."""
RUNS = [step for step in STEPS if step.script]
every_workflow = pytest.mark.parametrize("name", WORKFLOWS)
every_job = pytest.mark.parametrize(("name", "job"), JOBS, ids=lambda value: value)
every_run = pytest.mark.parametrize("step", RUNS, ids=str)


def job_of(name: str, job: str) -> dict[str, Any]:
    found: dict[str, Any] = WORKFLOWS[name]["jobs"][job]
    return found


@every_workflow
def test_a_workflow_has_no_rights_that_a_job_does_not_ask_for(name: str) -> None:
    assert WORKFLOWS[name]["permissions"] == {}


@every_job
def test_a_job_changes_only_what_it_is_there_for(name: str, job: str) -> None:
    rights = job_of(name, job)["permissions"]
    assert {key for key, right in rights.items() if right == "write"} == WRITES.get((name, job), set())
    assert {key for key, right in rights.items() if right != "write"} <= {"contents"}


@pytest.mark.parametrize(("name", "job"), MACHINES, ids=lambda value: value)
def test_a_job_ends(name: str, job: str) -> None:
    assert 0 < job_of(name, job)["timeout-minutes"] <= 360


@every_workflow
def test_no_workflow_gives_the_rights_of_this_repository_to_a_change_of_strangers(name: str) -> None:
    triggers = WORKFLOWS[name]["on"]
    assert {"pull_request_target", "workflow_run", "issue_comment"}.isdisjoint(triggers)
    jobs = WORKFLOWS[name]["jobs"].values()
    on_own_machine = [job for job in jobs if "self-hosted" in job.get("runs-on", "")]
    assert not on_own_machine or "pull_request" not in triggers


@pytest.mark.parametrize("name", sorted(ACTIONS))
def test_an_action_is_pinned_by_one_digest_with_its_version_behind_it(name: str) -> None:
    text = "\n".join(path.read_text() for path in FILES)
    uses = re.findall(rf"uses: {name}@(.*)$", text, re.MULTILINE)
    assert uses, "remove it from ACTIONS"
    (pin,) = set(uses)
    assert re.fullmatch(r"[0-9a-f]{40} # v\d+\.\d+\.\d+", pin)


def test_no_other_action_is_used() -> None:
    assert {step.uses.partition("@")[0] for step in STEPS if step.uses} == ACTIONS


def test_no_checkout_leaves_the_token_for_what_runs_after_it() -> None:
    checkouts = [step for step in STEPS if step.uses.startswith("actions/checkout@")]
    assert checkouts
    assert [str(step) for step in checkouts if step.inputs.get("persist-credentials") is not False] == []


@every_run
def test_a_script_takes_values_from_its_environment_so_that_none_becomes_code(step: Step) -> None:
    assert "${{" not in step.script


@every_run
def test_bash_can_parse_a_script(step: Step) -> None:
    run = subprocess.run(["bash", "-n"], input=step.script, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")


@every_run
def test_a_target_and_a_variable_of_make_exist(step: Step) -> None:
    makefile = (REPOSITORY / "Makefile").read_text()
    for words in re.findall(r"\bmake ([a-z][a-z-]*(?: \w+=(?:\"[^\"]*\"|\S+))*)", step.script):
        target, _, assignments = words.partition(" ")
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
        for variable in re.findall(r"(\w+)=", re.sub(r'"[^"]*"', "", assignments)):
            assert re.search(rf"^{variable} \?=", makefile, re.MULTILINE), variable


def test_actionlint_finds_nothing() -> None:
    own = REPOSITORY / "build" / "workflow-venv" / "bin"
    program = shutil.which("actionlint", path=f"{own}{os.pathsep}{os.environ['PATH']}")
    if program is None:
        pytest.skip("no actionlint on this machine: `make workflows` installs it")
    run = subprocess.run([program], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout + run.stderr) == (0, "")
