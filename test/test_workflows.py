"""The workflows for the site that hosts the repository: few rights, pinned actions, targets that exist."""

from __future__ import annotations

import re
import subprocess
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


WORKFLOWS: dict[str, dict[Any, Any]] = {path.stem: yaml.safe_load(path.read_text()) for path in FILES}
JOBS: list[tuple[str, str, dict[str, Any]]] = [
    (name, job, content) for name, workflow in WORKFLOWS.items() for job, content in workflow["jobs"].items()
]
STEPS: list[tuple[str, dict[str, Any]]] = [
    (f"{name}, {job}: {step.get('name', step.get('uses'))}", step)
    for name, job, content in JOBS
    for step in content.get("steps", [])
]
RUNS = [(where, step["run"]) for where, step in STEPS if "run" in step]


def test_a_workflow_has_no_rights_and_a_job_changes_only_what_it_is_there_for() -> None:
    assert [name for name, workflow in WORKFLOWS.items() if workflow["permissions"] != {}] == []
    written = {
        (name, job): {key for key, right in content["permissions"].items() if right == "write"}
        for name, job, content in JOBS
    }
    assert {where: rights for where, rights in written.items() if rights} == WRITES
    read = {key for *_, job in JOBS for key, right in job["permissions"].items() if right != "write"}
    assert read <= {"contents"}


def test_a_job_ends() -> None:
    limits = [job["timeout-minutes"] for *_, job in JOBS if "runs-on" in job]  # others are workflows
    assert limits
    assert all(0 < minutes <= 360 for minutes in limits)


def test_a_dead_link_is_an_error_of_the_site_and_no_page_loads_anything_from_another_host() -> None:
    configuration = (REPOSITORY / "mkdocs.yml").read_text()
    assert "\nstrict: true\n" in configuration
    validation = configuration.partition("\nvalidation:\n")[2].partition("\n\n")[0]
    assert set(re.findall(r": (\w+)", validation)) == {"warn"}  # which `strict` makes errors
    assert "\n  font: false" in configuration


def test_no_workflow_gives_the_rights_of_this_repository_to_a_change_of_strangers() -> None:
    for name, workflow in WORKFLOWS.items():
        triggers = workflow[True]  # what YAML makes of the key `on`
        assert {"pull_request_target", "workflow_run", "issue_comment"}.isdisjoint(triggers), name
        on_own_machine = ["self-hosted" in job.get("runs-on", "") for job in workflow["jobs"].values()]
        assert not any(on_own_machine) or "pull_request" not in triggers, name


def test_an_action_is_pinned_by_one_digest_with_its_version_behind_it_and_keeps_no_token() -> None:
    text = "\n".join(path.read_text() for path in FILES)
    pins = set(re.findall(r"uses: (?!\./)(\S+@.*)$", text, re.MULTILINE))
    assert sorted(pin.partition("@")[0] for pin in pins) == sorted(ACTIONS)
    assert [pin for pin in pins if not re.search(r"@[0-9a-f]{40} # v\d+\.\d+\.\d+$", pin)] == []
    checkouts = [step for _, step in STEPS if step.get("uses", "").startswith("actions/checkout@")]
    assert checkouts
    assert all(step["with"]["persist-credentials"] is False for step in checkouts)


def test_a_script_takes_values_from_its_environment_and_names_only_what_make_has() -> None:
    makefile, problems = (REPOSITORY / "Makefile").read_text(), []
    for where, script in RUNS:
        run = subprocess.run(["bash", "-n"], input=script, capture_output=True, text=True, check=False)
        if "${{" in script or run.returncode != 0 or run.stderr:
            problems.append(f"{where}: a value that would become code, or no bash: {run.stderr}")
        for words in re.findall(r"\bmake ([a-z][a-z-]*(?: \w+=(?:\"[^\"]*\"|\S+))*)", script):
            target, _, assignments = words.partition(" ")
            names = re.findall(r"(\w+)=", re.sub(r'"[^"]*"', "", assignments))
            lines = [f"^{target}:", *(rf"^{name} \?=" for name in names)]
            problems += [f"{where}: {line}" for line in lines if not re.search(line, makefile, re.MULTILINE)]
    assert problems == []
