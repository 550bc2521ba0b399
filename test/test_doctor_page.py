"""docs/doctor.md explains every line of the report, with the texts of the code."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY
from support.pages import table

from yolov5_lifecycle.doctor import cameras
from yolov5_lifecycle.doctor.examination import NAMES, planned

PAGE = REPOSITORY / "docs" / "doctor.md"
PROSE = re.sub(r"`[^`]*`", "", re.sub(r"```.*?```", "", PAGE.read_text(), flags=re.DOTALL))
SOURCES = [
    *(REPOSITORY / "yolov5_lifecycle").glob("**/doctor/*.py"),
    REPOSITORY / "yolov5_lifecycle" / "ros" / "shared_memory.py",
]


def texts(tree: ast.AST) -> list[str]:
    """The texts in `tree`, each whole; what an f-string inserts is {}."""
    if isinstance(tree, ast.JoinedStr):
        return ["".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in tree.values)]
    if isinstance(tree, ast.Constant):
        return [tree.value] if isinstance(tree.value, str) else []
    return [text for node in ast.iter_child_nodes(tree) for text in texts(node)]


def test_every_line_of_the_report_is_explained() -> None:
    groups = {each.name: import_module(each.module).CHECKS[each.name] for each in planned(Path("/nowhere"))}
    subjects = [subject for group in (groups | cameras.CHECKS).values() for subject in group]
    assert sorted(row[0].strip("`") for row in table(PAGE, "Lines")) == sorted(subjects)


def test_the_groups_are_those_of_the_page() -> None:
    (row,) = [row for row in table(PAGE, "Options") if "--only" in row[0]]
    assert set(re.findall(r"`(\w+)`", row[1])) == set(NAMES)


@pytest.mark.long
@pytest.mark.parametrize("words", sorted(set(re.findall(r"\*([^*]+)\*", " ".join(PROSE.split())))))
def test_the_words_of_a_line_on_the_page_are_those_of_the_code(words: str) -> None:
    told = [text for source in SOURCES for text in texts(ast.parse(source.read_text()))]
    assert any(words.removesuffix(" ...") in text for text in told)
