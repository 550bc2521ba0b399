"""The messages that docs/troubleshooting.md quotes are those of the code."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence

import pytest
from support.colcon_workspace import REPOSITORY
from support.pages import TROUBLESHOOTING, blocks, spans

from yolov5_lifecycle.streaming.frame_statistics import Outcome

MARKED = r"(?<![\w*`])\*([^*`]+?)\*(?![\w*])"
FOREIGN = {
    "Transitioning failed",
    "Unknown transition requested",
    "Node not found",
    "No module named 'torch'",
    "Corrupt JPEG data",
    "Trying to set a read-only parameter",
    "Bus error",
}
"""Messages of ROS, Python, OpenCV and the kernel."""
VALUE = re.compile(r"\||\d+ s\b|\S*[\d_/\[\]~'.]\S+|\b(?:cpu|cameras|front|rear|left|fornt)\b")
"""What the code inserts: numbers, topics, settings, classes, devices and cameras."""
TYPED = re.compile(
    r"(ros2|fastdds|colcon|ulimit) |-[pr] |\[|\w+: (true|0|\"0\"|cpu|int8|auto|cuda|compressed)$"
)


def messages_of_the_page() -> list[str]:
    """What is printed in italics, and in code what nobody types; the block of text, too."""
    prose = re.sub(r"^ *```.*?^ *```", "", TROUBLESHOOTING.read_text(), flags=re.MULTILINE | re.DOTALL)
    marked = [" ".join(text.split()) for text in re.findall(MARKED, prose)]
    quoted = [text for text in spans(TROUBLESHOOTING) if " " in text and not TYPED.match(text)]
    printed = [" ".join(text.split()) for text in blocks(TROUBLESHOOTING, "text")]
    return sorted({*marked, *quoted, *printed} - FOREIGN)


def texts(tree: ast.Module) -> Iterator[str]:
    """The texts of the code without docstrings; f-strings are cut where they insert a value."""
    described = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in described:
            yield " ".join(node.value.split())


@pytest.fixture(scope="module")
def written() -> list[str]:
    """The texts of the package, the longest first."""
    files = (REPOSITORY / "yolov5_lifecycle").rglob("*.py")
    found = {text.strip(" .,;:()'") for file in files for text in texts(ast.parse(file.read_text()))}
    found |= {f"frames {outcome.value}" for outcome in Outcome}
    return sorted(found, key=len, reverse=True)


def unknown(message: str, written: Sequence[str]) -> list[str]:
    """The words of `message` that are neither in the code nor a value that the code inserts.

    First whole texts of the code are taken away, then the rest is cut at the values: what is left between two
    of them must be a part of a text.
    """
    for text in written:
        if " " in text:
            message = message.replace(text, "|")
    rest = re.split(VALUE, message)
    parts = (part.strip(" .,;:()?'") for part in rest)
    return [part for part in parts if not any(part in text for text in written)]


@pytest.mark.long
@pytest.mark.parametrize("message", messages_of_the_page())
def test_a_quoted_message_is_one_of_the_code(message: str, written: list[str]) -> None:
    assert unknown(message, written) == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("message", "expected"),
    [
        pytest.param(
            "no pictures on /yolov5/image_raw for 12 s, although the topic has a publisher",
            ["no pictures on"],
            id="a word",
        ),
        pytest.param("10 of 40 images were lost somewhere", ["images were lost somewhere"], id="the end"),
        pytest.param("made up", ["made up"], id="all of it"),
    ],
)
def test_another_message_is_not(message: str, expected: list[str], written: list[str]) -> None:
    assert unknown(message, written) == expected


def test_messages_of_others_are_quoted() -> None:
    assert set(spans(TROUBLESHOOTING)) >= FOREIGN
