"""The workflows for the site that hosts the repository: few rights, and none for code of strangers."""

from __future__ import annotations

import re
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
FILES = sorted((REPOSITORY / ".github" / "workflows").glob("*.yml"))
WORKFLOWS: dict[str, dict[Any, Any]] = {path.stem: yaml.safe_load(path.read_text()) for path in FILES}
JOBS: list[tuple[str, str, dict[str, Any]]] = [
    (name, job, content) for name, workflow in WORKFLOWS.items() for job, content in workflow["jobs"].items()
]
STEPS: list[dict[str, Any]] = [step for *_, content in JOBS for step in content.get("steps", [])]


def test_a_workflow_has_no_rights_and_a_job_changes_only_what_it_is_there_for() -> None:
    assert [name for name, workflow in WORKFLOWS.items() if workflow["permissions"] != {}] == []
    written = {
        (name, job): {key for key, right in content["permissions"].items() if right == "write"}
        for name, job, content in JOBS
    }
    assert {where: rights for where, rights in written.items() if rights} == WRITES
    read = {key for *_, job in JOBS for key, right in job["permissions"].items() if right != "write"}
    assert read <= {"contents"}


def test_no_workflow_gives_the_rights_of_this_repository_to_a_change_of_strangers() -> None:
    for name, workflow in WORKFLOWS.items():
        triggers = workflow[True]  # what YAML makes of the key `on`
        assert {"pull_request_target", "workflow_run", "issue_comment"}.isdisjoint(triggers), name
        on_own_machine = ["self-hosted" in job.get("runs-on", "") for job in workflow["jobs"].values()]
        assert not any(on_own_machine) or "pull_request" not in triggers, name
    assert [step["run"] for step in STEPS if "${{" in step.get("run", "")] == [], "it would become code"


def test_an_action_is_pinned_by_one_digest_with_its_version_behind_it_and_keeps_no_token() -> None:
    text = "\n".join(path.read_text() for path in FILES)
    pins = set(re.findall(r"uses: (?!\./)(\S+@.*)$", text, re.MULTILINE))
    assert len(pins) == len({pin.partition("@")[0] for pin in pins}) > 0
    assert {pin.partition("/")[0] for pin in pins} == {"actions"}, "what others made runs in our name"
    assert [pin for pin in pins if not re.search(r"@[0-9a-f]{40} # v\d+\.\d+\.\d+$", pin)] == []
    checkouts = [step for step in STEPS if step.get("uses", "").startswith("actions/checkout@")]
    assert checkouts
    assert all(step["with"]["persist-credentials"] is False for step in checkouts)
