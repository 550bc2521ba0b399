"""Foreign text is made printable wherever it is shown: log, diagnostics, responses, terminal."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.commands.convert import main as convert
from yolov5_lifecycle.offline.detect_bag import main as detect_bag
from yolov5_lifecycle.printable import MAX_LINE, MAX_TEXT, in_lines, in_one_line

ESCAPES = "\x1b[2J\x1b]0;title\x07\x9b31m\r\n[INFO] [1.0] [yolov5]: forged\u202egnp.\u2066\u200b\x00\x08\x7f"
MARK = "hostile"
HOSTILE = f"{MARK}{ESCAPES}"
JOINERS = "\u200c\u200d"
LONG = HOSTILE * 3_000


@given(
    st.text() | st.text(st.sampled_from("aé👩\u200c\u200d\u202e "), max_size=12),
    st.integers(40, 80),
)
def test_one_line_is_printable_and_bounded_and_nothing_hides_behind_a_joiner(text: str, limit: int) -> None:
    line = in_one_line(text, limit)
    assert is_safe(line)
    assert len(line) <= limit
    assert in_one_line(line) == line


def is_safe(line: str) -> bool:
    """Whether all is printable, but for zero-width joiners between two letters that are not ASCII."""
    padded = f" {line} "
    return all(
        here.isprintable()
        or (here in JOINERS and all(c.isprintable() and not c.isascii() for c in (before, after)))
        for before, here, after in zip(padded, padded[1:], padded[2:], strict=False)
    )


@given(st.text(st.sampled_from("a \n\r\t\x1b\u2028\x0b\x85"), max_size=300), st.integers(40, 80))
def test_later_lines_are_printable_indented_and_bounded(text: str, limit: int) -> None:
    lines = in_lines(text, limit).split("\n")
    assert all(is_safe(line) for line in lines)
    assert all(line.startswith("  ") for line in lines[1:-1])
    assert len("\n".join(lines)) <= limit


def test_harmless_text_is_unchanged_and_a_long_one_is_cut_with_its_length() -> None:
    assert in_one_line("größer als 3\n") == "größer als 3"
    assert in_one_line("می\u200cشود") == "می\u200cشود", "a joiner of Persian"
    assert in_lines("one\n  two\n\tthree") == "one\n  two\n    three"
    assert in_lines("one\ntwo\n  three") == "one\n  two\n    three"
    assert in_one_line("x" * 300_000).endswith("... (300000 characters)")
    assert len(in_one_line("x" * 300_000)) == MAX_LINE
    assert len(in_lines("x\n" * 300_000)) == MAX_TEXT


def escaped(text: str) -> str:
    """What of `text` is not fit to be shown, with the few letters before it."""
    bad = next((i for i, letter in enumerate(text) if not letter.isprintable() and letter != "\n"), None)
    forged = [line for line in text.split("\n")[1:] if not line.startswith("  ")]
    return repr(text[max(0, bad - 80) : bad + 20]) if bad is not None else "".join(forged[:1])


def test_foreign_text_is_printable_in_answers_log_and_diagnostics(ros_domain: int, tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(f'"/**": {{ros__parameters: {{"{MARK}\\e[31m": 1, classes: ["{MARK}\\e[2J"]}}}}')
    prepare = Preparations()
    with ServedNode(prepare, arguments=["--ros-args", "--params-file", str(file)]) as served:
        shown = [served.status().message] if not served.transition("configure") else []
        (dropped,) = served.set_one_by_one([Parameter(f"{MARK}\x1b[31m").to_parameter_msg()])
        assert dropped.successful
        refused = [served.set(weights=HOSTILE, iou_threshold=HOSTILE), served.set(**{MARK + ESCAPES: LONG})]
        assert [done for done, _ in refused] == [False, False]
        assert not served.transition(HOSTILE)
        assert served.set(weights=HOSTILE, classes=[LONG]) == (True, "")
        assert served.transition("configure")
        served.wait_for_log("configured with")
        prepare.refusal = HOSTILE
        assert not served.transition("activate")
        shown += [served.status().message]
        prepare.refusal = ""
        assert served.set(classes=["cat"]) == (True, "")
        assert served.transition("activate")
        assert MARK not in served.status().message
        header = Header(frame_id=HOSTILE)
        for encoding in (HOSTILE, LONG):
            bad = Image(header=header, encoding=encoding, height=1, width=1, data=array("B", [0]))
            served.publish(bad)
            served.wait_for(lambda: MARK in served.status().message, "the rejected image")
            shown += [served.status().message]
        assert served.set(image_transport="compressed") == (True, "")
        compressed = served.client.create_publisher(CompressedImage, "/yolov5/image_raw/compressed", 1)
        rejected = served.counts()["rejected"]

        def is_rejected() -> bool:
            compressed.publish(CompressedImage(header=header, format=LONG, data=[1, 2]))
            return served.counts()["rejected"] > rejected

        served.wait_for(is_rejected, "the rejected compressed image")
        values = served.values()
        assert sum(map(len, values.values())) < 50_000
        shown += [*(reason for _, reason in refused), *served.log, *values, *values.values()]
    assert sum(MARK in text for text in shown) > 9
    assert [found for text in shown if (found := escaped(text))] == []


@pytest.mark.parametrize(
    ("command", "target"),
    [pytest.param(convert, ["out.safetensors"], id="convert"), pytest.param(detect_bag, [], id="detect_bag")],
)
def test_a_command_shows_no_file_name_as_it_is(
    command: Callable[[list[str]], int], target: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / f"{MARK}\x1b[31m\u202e\n.pt"
    arguments = [str(source), *(str(tmp_path / name) for name in target)]
    assert command(arguments) != 0
    source.write_bytes(b"none")
    assert command(arguments) != 0
    told = capsys.readouterr().err
    assert MARK in told
    assert all(line.isprintable() for line in told.split("\n"))
