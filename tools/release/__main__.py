"""Builds and checks a release of the last commit: `python -m tools.release --help`."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from tools.release.commit import REPOSITORY, Commit
from tools.release.interfaces_build import NAME as INTERFACES
from tools.release.interfaces_build import build_interfaces, interfaces_environment
from tools.release.package_build import archived_files, build_package, content_problems
from tools.release.versions import version_problems

BUILD = REPOSITORY / "build"
OUTPUT = BUILD / "dist"
SCRATCH = BUILD / "release"
OTHER_SURROUNDINGS = {"LC_ALL": "C", "PYTHONHASHSEED": "1", "TZ": "Pacific/Kiritimati"}
"""What must not change the bytes of a build, besides its folder."""


def parser() -> argparse.ArgumentParser:
    """The steps and their arguments."""
    steps = argparse.ArgumentParser(prog="python -m tools.release", description=__doc__)
    by_name = steps.add_subparsers(dest="step", required=True)
    versions = by_name.add_parser("versions", help="compare the version in all places where it is written")
    versions.add_argument("tag", nargs="?", default="", help="the tag of the release, such as v1.0.0")
    by_name.add_parser("package", help=f"build the source archive and the wheel into {OUTPUT}")
    interfaces = by_name.add_parser("interfaces", help=f"build the wheels of the messages into {OUTPUT}")
    interfaces.add_argument("pythons", nargs="*", help="interpreters, such as python3.12; default: this one")
    by_name.add_parser("reproducible", help=f"build all again elsewhere, and compare with {OUTPUT}")
    return steps


def main() -> int:
    """Return 0 if the step succeeded, 1 otherwise."""
    options = parser().parse_args()
    commit = Commit()
    if options.step == "versions":
        return told(version_problems(REPOSITORY, options.tag))
    for line in commit.uncommitted():
        print(f"not committed, so no part of the release: {line}")
    try:
        if options.step == "package":
            return package(commit)
        return interfaces(commit, options.pythons) if options.step == "interfaces" else reproducible(commit)
    except subprocess.CalledProcessError as error:
        return told([str(error)])


def package(commit: Commit) -> int:
    """Build the package, and compare the source archive with the commit."""
    archive, wheel = build_package(exported(commit, "source"), OUTPUT, dated(commit))
    print(f"{archive}\n{wheel}")
    return told(content_problems(archived_files(archive), commit.files()))


def interfaces(commit: Commit, pythons: Sequence[str]) -> int:
    """Build one wheel of the messages for each interpreter, or for this one; a missing one is a problem."""
    for older in OUTPUT.glob(f"{INTERFACES}-*.whl"):
        older.unlink()
    missing = [python for python in pythons if not shutil.which(python)]
    interpreters = [
        interfaces_environment(python, SCRATCH / Path(python).name, REPOSITORY / "requirements")
        for python in pythons
        if python not in missing
    ]
    for interpreter in interpreters if pythons else [Path(sys.executable)]:
        source = exported(commit, "source") / "interfaces"
        print(build_interfaces(source, OUTPUT, interpreter, dated(commit)))
    return told([f"{python}: no such program, so no wheel of the messages for it" for python in missing])


def reproducible(commit: Commit) -> int:
    """Build the package and this Python's wheel of the messages in another folder; compare the bytes."""
    again, surroundings = SCRATCH / "again", dated(commit) | OTHER_SURROUNDINGS
    shutil.rmtree(again, ignore_errors=True)
    source = exported(commit, "same_source_elsewhere")
    built = build_package(source, again, surroundings)
    built.append(build_interfaces(source / "interfaces", again, Path(sys.executable), surroundings))
    differing = [file.name for file in built if digest(file) != digest(OUTPUT / file.name)]
    for file in built:
        print(f"{digest(file)}  {file.name}")
    return told([f"{name}: a second build in another folder has other bytes" for name in differing])


def exported(commit: Commit, name: str) -> Path:
    """The files of the commit in a fresh folder."""
    shutil.rmtree(SCRATCH / name, ignore_errors=True)
    return commit.export(SCRATCH / name)


def dated(commit: Commit) -> dict[str, str]:
    """The variable that gives all files in an archive the time of the commit."""
    return {"SOURCE_DATE_EPOCH": str(commit.time())}


def digest(file: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits; that of nothing for a file that does not exist."""
    return sha256(file.read_bytes() if file.exists() else b"").hexdigest()


def told(problems: Sequence[str]) -> int:
    """Print the problems; returns the exit status."""
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
