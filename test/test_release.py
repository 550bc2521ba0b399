"""What a release consists of, what PyPI shows of it, and what is said of its changes."""

from __future__ import annotations

import os
import platform
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.colcon_workspace import PACKAGE, REPOSITORY, clone, published_files

from tools.release import archived_files, content_problems, exported, version_problems
from tools.release_notes import notes
from yolov5_lifecycle.doctor.system import NEWEST_PYTHON, OLDEST_PYTHON

pytestmark = pytest.mark.long

ADDRESS = "https://git.example.org/somebody/yolov5"
RELATIVE = re.compile(r"\]\((?!\w+:|#)")


def described(folder: Path, *urls: str) -> str:
    """The description that setup.py gives to PyPI, with addresses added to package.xml."""
    for name in ("setup.py", "README.md", "package.xml", "pyproject.toml"):
        shutil.copy2(REPOSITORY / name, folder)
    manifest = folder / "package.xml"
    manifest.write_text(manifest.read_text().replace("</license>", "</license>" + "".join(urls)))
    command = [sys.executable, "-W", "ignore", "setup.py", "--quiet", "--long-description"]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def test_without_an_address_of_the_repository_the_description_has_no_link_into_it(tmp_path: Path) -> None:
    text = described(tmp_path)
    assert text.startswith(f"# {PACKAGE}\n")
    assert "![" not in text
    assert not RELATIVE.search(text)
    assert "of v3 to v7" in text


def test_with_an_address_the_links_of_the_description_lead_to_the_tag_of_the_release(tmp_path: Path) -> None:
    text = described(tmp_path, f'<url type="repository">{ADDRESS}</url>')
    version = distribution(PACKAGE).version
    assert not RELATIVE.search(text)
    assert f"({ADDRESS}/blob/v{version}/docs/models.md)" in text
    assert f"({ADDRESS}/raw/v{version}/docs/images/annotated.png)" in text


def test_the_pythons_of_the_metadata_are_those_of_the_doctor_and_of_make() -> None:
    metadata = distribution(PACKAGE).metadata
    found = re.findall(r"Python :: (\d+)\.(\d+)", "\n".join(metadata.get_all("Classifier") or []))
    versions = sorted((int(major), int(minor)) for major, minor in found)
    machine = runpy.run_path(str(REPOSITORY / "requirements" / "check_machine.py"))
    assert versions == [(3, minor) for minor in range(versions[0][1], versions[-1][1] + 1)]
    assert versions[0] == OLDEST_PYTHON == machine["OLDEST"]
    assert versions[-1] == NEWEST_PYTHON == max(machine["NEWEST"].values())
    assert metadata["Requires-Python"] == ">={}.{}".format(*OLDEST_PYTHON)


def test_the_extra_ros_needs_the_messages_of_the_same_version() -> None:
    lines = distribution(PACKAGE).requires or []
    of_ros = {Requirement(line).name: Requirement(line) for line in lines if 'extra == "ros"' in line}
    assert of_ros[f"{PACKAGE}_interfaces"].specifier.contains(distribution(PACKAGE).version)
    assert of_ros["ros-rclpy"].extras == {"fastrtps"}


def test_the_messages_need_the_packages_that_they_were_compiled_with() -> None:
    try:
        messages = distribution(f"{PACKAGE}_interfaces")
    except PackageNotFoundError:
        pytest.skip("the messages come from apt")
    requirements = [Requirement(line) for line in messages.requires or []]
    assert {canonicalize_name(each.name) for each in requirements} >= {"ros-geometry-msgs", "ros-std-msgs"}
    for each in requirements:
        assert each.specifier.contains(distribution(each.name).version)


def test_nothing_of_the_build_machine_is_in_the_messages() -> None:
    files = distribution(f"{PACKAGE}_interfaces").files or []
    compiled = [file for file in files if file.suffix in (".so", ".py", ".idl", "")]
    assert len(compiled) > 30
    home = str(REPOSITORY).encode()
    # What pip writes while it installs names the folder of a wheel that was built here.
    assert [file for file in compiled if ".dist-info" not in str(file) and home in file.read_binary()] == []


def test_a_file_is_missing_in_the_source_archive_or_is_too_much() -> None:
    generated = {"PKG-INFO", f"{PACKAGE}.egg-info/SOURCES.txt"}
    assert content_problems({"setup.py", *generated}, {"setup.py"}) == []
    forgotten, foreign = content_problems({"setup.py", "build/x"}, {"setup.py", "docs/new.md"})
    assert "docs/new.md: committed, but not in the source archive" in forgotten
    assert "build/x: in the source archive, but not committed" in foreign


@pytest.mark.parametrize(
    ("changed", "old", "new", "tag", "problem"),
    [
        pytest.param("package.xml", "", "", "v1.2.0", "", id="all agree"),
        pytest.param("CHANGELOG.md", "[1.2.0]", "[Unreleased]", "", "", id="nothing released yet"),
        pytest.param("package.xml", "", "", "1.2.0", "tag 1.2.0: expected v1.2.0", id="tag without v"),
        pytest.param(
            "CITATION.cff", "1.2.0", "1.1.0", "", "CITATION.cff: expected version 1.2.0", id="other"
        ),
        pytest.param("CHANGELOG.md", "[1.2.0]", "[Unreleased]", "v1.2.0", "found none", id="no notes"),
    ],
)
def test_a_version_that_differs_is_named(
    tmp_path: Path, changed: str, old: str, new: str, tag: str, problem: str
) -> None:
    (tmp_path / "interfaces").mkdir()
    texts = {
        "package.xml": "<package><version>1.2.0</version></package>",
        "interfaces/pyproject.toml": '[project]\nversion = "1.2.0"\n',
        "CITATION.cff": "cff-version: 1.2.1\nversion: 1.2.0\n",
        "CHANGELOG.md": "# Changelog\n\n## [Unreleased]\n\n## [1.2.0] - 2026-01-01\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text.replace(old, new, 1) if name == changed else text)
    found = version_problems(tmp_path, tag)
    assert len(found) == bool(problem)
    assert problem in "".join(found)


def test_a_commit_is_exported_without_what_is_not_committed(tmp_path: Path) -> None:
    repository = tmp_path / "repository"
    repository.mkdir()
    (repository / "kept").write_text("kept")
    (repository / "kept").chmod(0o600)
    identity = ["-c", "user.email=a@example.org", "-c", "user.name=A"]
    for words in (["init", "-q"], ["add", "kept"], [*identity, "commit", "-q", "-m", "kept"]):
        subprocess.run(["git", *words], cwd=repository, check=True)
    (repository / "new").write_text("new")
    (file,) = exported(tmp_path / "exported", repository).iterdir()
    assert (file.name, file.stat().st_mode & 0o777) == ("kept", 0o644)


MESSAGES = (
    f"build/dist/{PACKAGE}_interfaces-{{version}}-cp{{python}}-cp{{python}}-manylinux_2_34_{{machine}}.whl"
)
HERE = {
    "version": distribution(PACKAGE).version,
    "python": f"{sys.version_info[0]}{sys.version_info[1]}",
    "machine": platform.machine(),
}


@pytest.mark.parametrize(
    ("wheel", "is_newer", "is_used"),
    [
        pytest.param(HERE, True, True, id="of this release"),
        pytest.param(HERE, False, False, id="older than the messages"),
        pytest.param(HERE | {"version": "9.9.9"}, True, False, id="of another version"),
        pytest.param(HERE | {"machine": "riscv64"}, True, False, id="for another processor"),
    ],
)
def test_make_installs_the_messages_of_a_release_if_they_fit(
    tmp_path: Path, wheel: dict[str, str], is_newer: bool, is_used: bool
) -> None:
    for name in ("Makefile", "package.xml"):
        shutil.copy2(REPOSITORY / name, tmp_path)
    shutil.copytree(REPOSITORY / "interfaces", tmp_path / "interfaces")
    file = tmp_path / MESSAGES.format_map(wheel)
    file.parent.mkdir(parents=True)
    file.touch()
    newest = max(source.stat().st_mtime for source in tmp_path.rglob("interfaces/**/*"))
    os.utime(file, (newest + 1, newest + (1 if is_newer else -1)))
    # Neither made nor looked at: what the environment is made from.
    old = [f"--old-file=.venv/.dependencies-{sys.version_info[0]}.{sys.version_info[1]}"]
    command = ["make", "--dry-run", *old, f"PYTHON={sys.executable}", ".venv/.interfaces"]
    told = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert (f"Installing vision_msgs bond from {file.relative_to(tmp_path)}." in told) == is_used
    assert ("Building vision_msgs bond into .venv" in told) != is_used


@pytest.mark.parametrize(
    ("wheel", "problem"),
    [
        pytest.param([], "a C++ compiler", id="to be compiled"),
        pytest.param(["messages.whl"], "", id="compiled already"),
    ],
)
def test_a_compiler_is_needed_only_if_the_messages_are_not_compiled_yet(
    wheel: list[str], problem: str
) -> None:
    program = REPOSITORY / "requirements" / "check_machine.py"
    command = [sys.executable, "-I", str(program), "tested", *wheel]
    told = subprocess.run(command, env={"PATH": ""}, capture_output=True, text=True, check=False)
    assert problem in told.stderr
    assert told.returncode == bool(problem)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """What a clone of the working tree would hold."""
    return clone(tmp_path / "source")


def packed(source: Path, output: Path) -> Path:
    """The source archive of the folder `source`, in the new folder `output`."""
    command = [sys.executable, "-W", "ignore", "setup.py", "--quiet", "sdist", "--dist-dir", str(output)]
    subprocess.run(command, cwd=source, check=True)
    (archive,) = output.iterdir()
    return archive


def test_the_source_archive_holds_what_a_clone_holds_and_is_the_same_wherever_it_is_packed(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    first = packed(source, tmp_path / "first")
    assert content_problems(archived_files(first), {str(file) for file in published_files()}) == []
    (source / "setup.py").touch()
    (source / "LICENSE").chmod(0o600)
    second = packed(source.rename(tmp_path / "elsewhere"), tmp_path / "second")
    assert first.read_bytes() == second.read_bytes()
    with tarfile.open(first) as archive:
        assert {(member.mtime, member.uid, member.uname) for member in archive} == {(1700000000, 0, "root")}


CHANGELOG = """\
## [Unreleased]
- Not yet.

## [1.10.0] - 2027-01-02
- Ten.

## [1.1.0] - 2026-12-24
- One; `## [9.9.9]` is no heading.

## [1.0.0] - 2026-12-01

[1.1.0]: https://example.org/1.1.0
"""


def test_the_notes_are_the_section_of_the_version() -> None:
    assert notes(CHANGELOG, "v1.10.0") == "- Ten.\n"
    assert notes(CHANGELOG, "v1.1.0") == "- One; `## [9.9.9]` is no heading.\n"


@pytest.mark.parametrize(
    ("tag", "told"),
    [
        pytest.param("v1.0.0", "Rename the heading", id="nothing below the heading"),
        pytest.param("v1x1.0", "Rename the heading", id="a pattern that fits another number"),
        pytest.param("1.1.0", "expected a version behind 'v'", id="a tag without v"),
    ],
)
def test_a_tag_without_notes_is_refused(tag: str, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        notes(CHANGELOG, tag)


def test_a_version_without_changes_is_refused_with_the_remedy_and_without_any_package() -> None:
    command = [sys.executable, "-I", "-S", str(REPOSITORY / "tools" / "release_notes.py"), "v999.0.0"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout) == (1, "")
    assert "Rename the heading '## [Unreleased]'" in run.stderr
    assert "Traceback" not in run.stderr
