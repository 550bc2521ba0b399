"""docs/doctor.md explains every line of the report, with the texts and the remedies of the code."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY
from support.pages import spans, table

from yolov5_lifecycle.doctor.examinations import NAMES, planned
from yolov5_lifecycle.doctor.finding import Check

PAGE = REPOSITORY / "docs" / "doctor.md"
PROSE = re.sub(r"`[^`]*`", "", re.sub(r"```.*?```", "", PAGE.read_text(), flags=re.DOTALL))
SOURCES = [
    *sorted((REPOSITORY / "yolov5_lifecycle" / "doctor").glob("*.py")),
    *sorted((REPOSITORY / "yolov5_lifecycle" / "ros" / "doctor").glob("*.py")),
    REPOSITORY / "yolov5_lifecycle" / "ros" / "shared_memory.py",
]
MODULES = dict.fromkeys(examination.module for examination in planned(Path("/nowhere")))


def checks() -> dict[str, Check]:
    found: dict[str, Check] = {}
    for module in MODULES:
        found |= import_module(module).CHECKS
    found |= import_module("yolov5_lifecycle.doctor.cameras").CHECKS
    return found


def texts(tree: ast.AST) -> list[str]:
    """The texts in `tree`, each whole; what an f-string inserts is {}."""
    if isinstance(tree, ast.JoinedStr):
        return ["".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in tree.values)]
    if isinstance(tree, ast.Constant):
        return [tree.value] if isinstance(tree.value, str) else []
    return [text for node in ast.iter_child_nodes(tree) for text in texts(node)]


def remedies() -> list[str]:
    """The texts of all remedies: given where something is found, or to an examination."""
    found = []
    for source in SOURCES:
        for node in ast.walk(ast.parse(source.read_text())):
            is_given = isinstance(node, ast.keyword) and node.arg == "remedy"
            if is_given or (isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "remedy"):
                found += texts(node)
    return found


def test_every_line_of_the_report_is_explained() -> None:
    rows = [row[0].strip("`") for row in table(PAGE, "Lines")]
    assert sorted(rows) == sorted(checks())


def test_the_groups_are_those_of_the_page() -> None:
    (row,) = [row for row in table(PAGE, "Options") if "--only" in row[0]]
    assert set(re.findall(r"`(\w+)`", row[1])) == set(NAMES)


def test_the_commands_of_all_remedies_are_on_the_page() -> None:
    commands = {command for remedy in remedies() for command in re.findall(r"`([^`]+)`", remedy)}
    assert len(commands) > 9
    known = set(spans(PAGE))
    assert [
        command for command in sorted(commands) if not re.search("[={]", command) and command not in known
    ] == []


@pytest.mark.long
@pytest.mark.parametrize("words", sorted(set(re.findall(r"\*([^*]+)\*", " ".join(PROSE.split())))))
def test_the_words_of_a_line_on_the_page_are_those_of_the_code(words: str) -> None:
    told = [text for source in SOURCES for text in texts(ast.parse(source.read_text()))]
    assert any(words.removesuffix(" ...") in text for text in told)
