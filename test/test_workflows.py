"""The workflows for the site that hosts the repository: few rights, pinned actions, and steps that can run.

Nobody runs a workflow here. Its steps are run instead, each in a copy of what it names, with stand-ins
for the programs of that site (docker, gh, ...) and for what takes long: test/support/workflow_steps.py.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from support.colcon_workspace import REPOSITORY, published_files
from support.workflow_steps import STEPS, WORKFLOWS, Step, at_tag, pages_of, recorded

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


def test_every_right_belongs_to_a_job() -> None:
    assert WRITES.keys() <= set(JOBS)


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
    text = "\n".join(path.read_text() for path in pages_of(".github/workflows", "*.yml"))
    uses = re.findall(rf"uses: {name}@(.*)$", text, re.MULTILINE)
    assert uses, "remove it from ACTIONS"
    (pin,) = set(uses)
    assert re.fullmatch(r"[0-9a-f]{40} # v\d+\.\d+\.\d+", pin)


def test_no_other_action_is_used() -> None:
    assert {step.uses.partition("@")[0] for step in STEPS if step.uses} == ACTIONS


def test_a_release_needs_all_tests() -> None:
    assert job_of("release", "tests")["uses"] == "./.github/workflows/test.yml"
    assert "workflow_call" in WORKFLOWS["test"]["on"]
    assert job_of("release", "publish")["needs"] == ["tests", "build"]
    assert job_of("release", "announce")["needs"] == "publish"


def test_a_job_calls_no_workflow_of_others() -> None:
    called = [job_of(*job)["uses"] for job in JOBS if job not in MACHINES]
    assert [name for name in called if not (name.startswith("./") and (REPOSITORY / name).is_file())] == []


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


@every_run
def test_a_file_of_the_repository_that_is_named_exists(step: Step) -> None:
    tops = {file.parts[0] for file in published_files() if len(file.parts) > 1}
    words = re.findall(r"(?<![\w./$-])[\w.-]+/[\w./-]+", step.script)
    named = [word for word in words if word.partition("/")[0] in tops]
    assert [word for word in named if not (REPOSITORY / word).exists()] == []


@pytest.mark.parametrize("path", pages_of(".ci", "*"), ids=lambda path: path.name)
def test_a_script_of_the_workflows_can_be_started_and_parsed(path: Path) -> None:
    assert os.access(path, os.X_OK)
    subprocess.run(["bash", "-n", path], check=True)


def test_actionlint_finds_nothing() -> None:
    own = REPOSITORY / "build" / "workflow-venv" / "bin"
    program = shutil.which("actionlint", path=f"{own}{os.pathsep}{os.environ['PATH']}")
    if program is None:
        pytest.skip("no actionlint on this machine: `make workflows` installs it")
    run = subprocess.run([program], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout + run.stderr) == (0, "")


@every_run
def test_a_step_runs_and_starts_what_it_is_there_for(step: Step, tmp_path: Path) -> None:
    done = recorded(step, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.commands, "it started nothing"


def test_an_image_is_tried_before_it_is_pushed() -> None:
    names = [step.name for step in RUNS if (step.workflow, step.job) == ("image", "push")]
    assert names == ["Build", "Try", "Push"]
    assert "docker/try-image yolov5_lifecycle" in at_tag("image", "push", "Try").script


def test_a_tag_pushes_each_architecture_under_its_own_name(tmp_path: Path) -> None:
    commands = recorded(at_tag("image", "push", "Push"), tmp_path).commands
    image = "ghcr.io/owner/robot.repository:1.2.3-arm64"
    assert f"docker tag yolov5_lifecycle {image}" in commands
    assert commands[-1] == f"docker push {image}"


def test_the_joined_image_is_given_to_the_attestation_by_its_digest(tmp_path: Path) -> None:
    done = recorded(at_tag("image", "join", "Join the architectures"), tmp_path)
    assert "name=ghcr.io/owner/robot.repository\n" in done.outputs
    assert "digest=sha256:" in done.outputs


def test_no_token_stands_in_the_arguments_of_a_login(tmp_path: Path) -> None:
    commands = recorded(at_tag("image", "push", "Push"), tmp_path).commands
    (login,) = [command for command in commands if command.startswith("docker login")]
    assert "secret" not in login


@pytest.mark.parametrize(
    ("ref", "deployed"),
    [
        pytest.param("v1.2.3", "mike deploy --update-aliases 1.2.3 latest", id="tag"),
        pytest.param("main", "mike deploy --update-aliases main", id="main"),
    ],
)
def test_the_site_has_a_folder_for_each_release_and_one_for_main(
    ref: str, deployed: str, tmp_path: Path
) -> None:
    step = at_tag("docs", "publish", "Publish", ref=ref)
    assert deployed in recorded(step, tmp_path).commands


def test_a_release_without_notes_stops_before_anything_is_built(tmp_path: Path) -> None:
    steps = [step for step in RUNS if (step.workflow, step.job) == ("release", "build")]
    assert steps[0].name == "Notes"
    done = recorded(steps[0], tmp_path, environment={"GITHUB_REF_NAME": "v999.0.0"})
    assert done.returncode == 1
    assert "expected changes below a heading" in done.stderr


def test_everything_that_is_uploaded_for_users_is_attested() -> None:
    steps = [step for step in STEPS if step.workflow == "release"]
    (attested,) = [step.inputs["subject-path"] for step in steps if step.uses.startswith("actions/attest@")]
    scripts = "\n".join(step.script for step in steps)
    assert f'twine" upload --non-interactive --attestations {attested}' in scripts
    assert f"notes.md {attested}" in scripts
