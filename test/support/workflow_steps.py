"""The steps of the workflows, and a machine on which they can run: what they would change is recorded."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from support.colcon_workspace import REPOSITORY

PROGRAMS = ("docker", "gh", "git", "make", "nvidia-smi", "python3", "sudo")
"""Of the machines of the site, or with effects of their own: recorded, but python3 runs a file of tools/."""
RUNNER = {
    "GITHUB_ACTOR": "somebody",
    "GITHUB_REF_NAME": "v1.2.3",
    "GITHUB_REF_TYPE": "tag",
    "GITHUB_REPOSITORY": "Owner/Robot.Repository",
    "GITHUB_SERVER_URL": "https://github.com",
    "TOKEN": "secret",
}
_STAND_IN = """\
#!/usr/bin/env bash
printf '%s' "${0##*/}" >> "$RECORD"
printf ' %s' "$@" >> "$RECORD"
printf '\\n' >> "$RECORD"
case "${0##*/} $*" in
  *"imagetools inspect"*) echo "sha256:$(printf 'a%.0s' {1..64})" ;;
esac
"""
_PYTHON = """\
#!/usr/bin/env bash
echo "python3 $*" >> "$RECORD"
case "$1" in
  tools/*) exec "$REAL_PYTHON" "$@" ;;
  -m) mkdir -p "$3/bin"
      for program in pip twine pypi-attestations; do ln -s "$STAND_IN" "$3/bin/$program"; done ;;
esac
"""


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
    environment: Mapping[str, str]

    def __str__(self) -> str:
        return f"{self.workflow}, {self.job}: {self.name}"


@dataclass(frozen=True)
class Done:
    """What a step did: exit status, output, the commands of the stand-ins, and what later steps get."""

    returncode: int
    stdout: str
    stderr: str
    commands: list[str]
    outputs: str


def pages_of(folder: str, pattern: str) -> list[Path]:
    """The files of a folder of the repository."""
    return sorted((REPOSITORY / folder).glob(pattern))


def _loaded(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.load(path.read_text(), _Loader)  # a SafeLoader
    return found


WORKFLOWS = {path.stem: _loaded(path) for path in pages_of(".github/workflows", "*.yml")}
STEPS = [
    Step(
        workflow,
        name,
        step.get("name", step.get("uses", "").partition("@")[0]),
        script=step.get("run", ""),
        uses=step.get("uses", ""),
        inputs=step.get("with", {}),
        environment=step.get("env", {}),
    )
    for workflow, content in WORKFLOWS.items()
    for name, job in content["jobs"].items()
    for step in job.get("steps", [])
]


def at_tag(workflow: str, job: str, name: str, ref: str = "v1.2.3") -> Step:
    """The step of that name, on the tag or branch `ref`, for arm64 where there is a choice."""
    (step,) = [step for step in STEPS if (step.workflow, step.job, step.name) == (workflow, job, name)]
    kind = "tag" if ref.startswith("v") else "branch"
    chosen = {"GITHUB_REF_NAME": ref, "GITHUB_REF_TYPE": kind, "ARCHITECTURE": "arm64"}
    return replace(step, environment=chosen)


def recorded(step: Step, folder: Path, environment: Mapping[str, str] = {}) -> Done:
    """Run the script of `step` in a copy of what it names, below `folder`, with stand-ins for PROGRAMS."""
    clone, programs = folder / "clone", folder / "programs"
    shutil.copytree(REPOSITORY / ".ci", clone / ".ci")
    shutil.copytree(REPOSITORY / "tools", clone / "tools", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy2(REPOSITORY / "package.xml", clone)
    _write_released_changelog(clone)
    _write_stand_ins(programs, clone)
    record, outputs = folder / "record", folder / "outputs"
    record.touch()
    outputs.touch()
    values = {
        **{name: value for name, value in os.environ.items() if not name.startswith(("GITHUB_", "ROS_"))},
        **RUNNER,
        **{name: value for name, value in step.environment.items() if "${{" not in value},
        "GITHUB_REF_NAME": step.environment.get("GITHUB_REF_NAME", _tag()),
        **environment,
        "GITHUB_OUTPUT": str(outputs),
        "PATH": f"{programs}:{os.environ['PATH']}",
        "REAL_PYTHON": shutil.which("python3") or "",
        "RECORD": str(record),
        "RUNNER_TEMP": str(folder),
        "STAND_IN": str(programs / "docker"),
    }
    run = subprocess.run(
        ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", step.script],
        cwd=clone,
        env=values,
        capture_output=True,
        text=True,
        check=False,
    )
    commands = record.read_text().splitlines()
    return Done(run.returncode, run.stdout, run.stderr, commands, outputs.read_text())


def _tag() -> str:
    version = re.search(r"<version>(.*?)</version>", (REPOSITORY / "package.xml").read_text())
    assert version is not None
    return f"v{version[1]}"


def _write_released_changelog(clone: Path) -> None:
    """The changelog as it is when a tag is made."""
    text = (REPOSITORY / "CHANGELOG.md").read_text()
    released = text.replace("## [Unreleased]", f"## [Unreleased]\n\n## [{_tag()[1:]}] - 2026-12-01", 1)
    (clone / "CHANGELOG.md").write_text(released)


def _write_stand_ins(programs: Path, clone: Path) -> None:
    programs.mkdir()
    of_site = clone / "build" / "site-venv" / "bin"
    of_site.mkdir(parents=True)
    files = [programs / program for program in PROGRAMS if program != "python3"]
    for file in (*files, of_site / "mike", clone / ".ci" / "run-on-ros"):
        file.write_text(_STAND_IN)
        file.chmod(0o755)
    (programs / "python3").write_text(_PYTHON)
    (programs / "python3").chmod(0o755)
