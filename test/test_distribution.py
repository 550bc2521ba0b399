"""What tells others about this package: pixi, ROS's pages, citation, quality declaration, issue forms."""

from __future__ import annotations

import re
from importlib.metadata import distribution
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.colcon_workspace import PACKAGE, REPOSITORY

pytestmark = pytest.mark.long

MANIFEST = ElementTree.parse(REPOSITORY / "package.xml")
OF_CONDA = {"torch": "pytorch", "opencv-python-headless": "py-opencv"}
FORMS = sorted(
    path for path in (REPOSITORY / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if path.stem != "config"
)
# REP-2004: from which level downwards a requirement is one, in the order of its chart.
REQUIRED_FROM = {
    "1.i": 3, "1.ii": 3, "1.iii": 2, "1.iv": 3, "1.v": 3, "1.vi": 2,
    "2.i": 3, "2.ii": 2, "2.iii": 1, "2.iv": 3, "2.v": 1,
    "3.i": 2, "3.ii": 1, "3.iii": 4, "3.iv": 4, "3.v": 2, "3.v.a": 3, "3.v.b": 0, "3.v.c": 3,
    "4.i": 2, "4.ii": 1, "4.iii.a": 2, "4.iii.b": 1, "4.iv.a": 1, "4.iv.b": 1, "4.v.a": 2, "4.v.b": 2,
    "5.i": 2, "5.ii": 0, "5.iii": 2, "6.i": 3, "7.i": 2,
}  # fmt: skip


def pixi_dependencies() -> dict[str, str]:
    """Name and version range of what pixi.toml takes from the conda channels."""
    section = (REPOSITORY / "pixi.toml").read_text().partition("[dependencies]\n")[2].partition("\n[")[0]
    return dict(re.findall(r'^([\w-]+) = "([^"]+)"', section, re.MULTILINE))


def declared_requirements() -> list[Requirement]:
    """What setup.py asks for, with OpenCV and scipy, which conda has for everybody."""
    requirements = [Requirement(line) for line in distribution(PACKAGE).requires or []]
    extras = {"", "opencv", "tracking"}
    return [
        each
        for each in requirements
        if each.marker is None or any(each.marker.evaluate({"extra": extra}) for extra in extras)
    ]


def test_pixi_installs_every_dependency_of_the_manifest() -> None:
    keys = {each.text or "" for each in MANIFEST.iter("exec_depend")}
    packages = {f"ros-jazzy-{key.replace('_', '-')}" for key in keys if not key.startswith("python3-")}
    assert packages <= pixi_dependencies().keys()


def test_pixi_installs_what_setup_asks_for_in_the_same_versions() -> None:
    ranges = {
        OF_CONDA.get(name, name): str(each.specifier) or "*"
        for each in declared_requirements()
        for name in [canonicalize_name(each.name)]
    }
    assert ranges.items() <= pixi_dependencies().items()


def test_ros_documentation_is_built_from_the_pages() -> None:
    (name,) = [each.text or "" for each in MANIFEST.iter("rosdoc2")]
    kind, config = yaml.safe_load_all((REPOSITORY / name).read_text())
    assert kind == {"type": "rosdoc2 config", "version": 1}
    (builder,) = config["builders"]
    assert (REPOSITORY / builder["sphinx"]["user_doc_dir"] / "parameters.md").is_file()


def test_the_citation_names_the_licence_and_the_people_of_the_manifest() -> None:
    citation: dict[str, Any] = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert citation["license"] == MANIFEST.findtext("license")
    assert [author["name"] for author in citation["authors"]] == [MANIFEST.findtext("maintainer")]
    assert citation["message"]
    assert citation["title"].startswith(PACKAGE)


def quality_rows() -> dict[str, str]:
    """Requirement -> yes, no or partly."""
    text = (REPOSITORY / "QUALITY_DECLARATION.md").read_text()
    return dict(re.findall(r"^\| (\d\.[iv.abc]+) [^|]*\| (\w+) \|", text, re.MULTILINE))


def test_the_quality_declaration_answers_every_requirement_in_order() -> None:
    assert list(quality_rows()) == list(REQUIRED_FROM)
    assert set(quality_rows().values()) <= {"yes", "no", "partly"}


def test_the_claimed_quality_level_is_the_highest_that_its_rows_allow() -> None:
    unmet = [REQUIRED_FROM[number] for number, answer in quality_rows().items() if answer != "yes"]
    claimed = re.search(r"\*\*Quality Level (\d)\*\*", (REPOSITORY / "QUALITY_DECLARATION.md").read_text())
    assert claimed is not None
    assert int(claimed[1]) == max(unmet, default=0) + 1


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_an_issue_form_is_one_that_the_site_can_show_and_asks_for_the_report_of_doctor(path: Path) -> None:
    form = yaml.safe_load(path.read_text())
    assert form.keys() <= {"name", "description", "title", "labels", "body"}
    assert form["name"]
    assert form["description"]
    fields = [field for field in form["body"] if field["type"] != "markdown"]
    assert {field["type"] for field in fields} <= {"textarea", "input", "dropdown", "checkboxes"}
    identities = [field["id"] for field in fields]
    assert len(set(identities)) == len(identities)
    assert all(field["attributes"]["label"] for field in fields)
    (report,) = [field for field in fields if field["id"] == "doctor"]
    assert "ros2 run yolov5_lifecycle doctor" in report["attributes"]["description"]


def test_the_form_for_a_fault_requires_the_report() -> None:
    form = yaml.safe_load((REPOSITORY / ".github" / "ISSUE_TEMPLATE" / "bug.yml").read_text())
    (report,) = [field for field in form["body"] if field.get("id") == "doctor"]
    assert report["validations"]["required"] is True


def test_a_rule_for_reviewers_names_an_account() -> None:
    lines = (REPOSITORY / ".github" / "CODEOWNERS").read_text().splitlines()
    rules = [line.split() for line in lines if line and not line.startswith("#")]
    assert all(rule[1:] and all("@" in owner for owner in rule[1:]) for rule in rules)
