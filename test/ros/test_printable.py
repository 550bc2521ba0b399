"""Foreign text is made printable wherever it is shown: log, diagnostics, responses, terminal."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header
from support.detector_process import as_arguments, detector_process, parameter_file
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.commands.convert import main as convert
from yolov5_lifecycle.offline.detect_bag import main as detect_bag
from yolov5_lifecycle.printable import MAX_LINE, MAX_TEXT, in_lines, in_one_line
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import SETTINGS

ESCAPES = "\x1b[2J\x1b]0;title\x07\x9b31m\r\n[INFO] [1.0] [yolov5]: forged\u202egnp.\u2066\u200b\x00\x08\x7f"
MARK = "hostile"
HOSTILE = f"{MARK}{ESCAPES}"
JOINERS = "\u200c\u200d"
LONG = HOSTILE * 3_000


@given(st.text(), st.integers(40, 80))
def test_one_line_is_printable_and_bounded(text: str, limit: int) -> None:
    line = in_one_line(text, limit)
    assert is_safe(line)
    assert len(line) <= limit


def is_safe(line: str) -> bool:
    """Whether all is printable, but for zero-width joiners between two letters that are not ASCII."""
    padded = f" {line} "
    return all(
        here.isprintable()
        or (here in JOINERS and all(c.isprintable() and not c.isascii() for c in (before, after)))
        for before, here, after in zip(padded, padded[1:], padded[2:], strict=False)
    )


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        pytest.param("👩\u200d👧", "👩\u200d👧", id="emoji"),
        pytest.param("می\u200cشود", "می\u200cشود", id="Persian"),
        pytest.param("c\u200dat", "c?at", id="between ASCII"),
        pytest.param("é\u200c", "é?", id="at the end"),
        pytest.param("\u200cé", "?é", id="at the beginning"),
        pytest.param("é\u200d\u200dé", "é??é", id="two"),
        pytest.param("é\u202e\u200dé", "é??é", id="beside another"),
        pytest.param("é\u200bé", "é?é", id="another character without width"),
    ],
)
def test_a_joiner_is_kept_where_it_joins(text: str, shown: str) -> None:
    assert in_one_line(text) == shown


@given(st.text(st.sampled_from("aé👩\u200c\u200d\u202e "), max_size=12))
def test_nothing_hides_behind_a_joiner(text: str) -> None:
    line = in_one_line(text)
    assert is_safe(line)
    assert in_one_line(line) == line


@given(st.text(st.sampled_from("a \n\r\t\x1b\u2028\x0b\x85"), max_size=300), st.integers(40, 80))
def test_later_lines_are_printable_indented_and_bounded(text: str, limit: int) -> None:
    lines = in_lines(text, limit).split("\n")
    assert all(is_safe(line) for line in lines)
    assert all(line.startswith("  ") for line in lines[1:-1])
    assert len("\n".join(lines)) <= limit


def test_harmless_text_is_unchanged_and_a_long_one_is_cut_with_its_length() -> None:
    assert in_one_line("größer als 3\n") == "größer als 3"
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


def test_foreign_text_of_a_request_is_printable_in_answer_log_and_diagnostics(ros_domain: int) -> None:
    with ServedNode(Preparations()) as served:
        refused = [served.set(weights=HOSTILE, iou_threshold=HOSTILE), served.set(**{MARK + ESCAPES: LONG})]
        assert [done for done, _ in refused] == [False, False]
        assert not served.transition(HOSTILE)
        assert served.set(weights=HOSTILE, classes=[LONG]) == (True, "")
        assert served.transition("configure")
        served.wait_for_log("configured with")
        values = served.values()
        shown = [*(reason for _, reason in refused), *served.log, *values, *values.values()]
    assert sum(MARK in text for text in shown) > 3
    assert [found for text in shown if (found := escaped(text))] == []


@pytest.mark.long
def test_foreign_text_is_printable_in_every_output_of_the_process(tmp_path: Path) -> None:
    file = parameter_file(tmp_path, f'"{MARK}\\e[31m": 1\nclasses: ["{MARK}\\e[2J"]')
    with detector_process(*file, *as_arguments({"device": "cpu", "lazy": False})) as detector:
        told: list[str] = []
        kept = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        detector.observer.create_subscription(Log, "/rosout", lambda log: told.append(log.msg), kept)

        def diagnose() -> None:
            values = detector.status()
            told.extend([*values, *values.values()])
            assert sum(map(len, values.values())) < 50_000

        def ask(text: str) -> None:
            names = [setting.name for setting in SETTINGS if setting.change is not Change.READ_ONLY]
            for value in (text, [text] * 3):
                parameters = [Parameter(name, value=value) for name in [*names, text[:200]]]
                results = detector.set_one_by_one([each.to_parameter_msg() for each in parameters])
                told.extend(result.reason for result in results)
                assert all(len(result.reason) < 10_000 for result in results)
            detector.transition(text)

        assert not detector.transition("configure")  # the file
        diagnose()
        for text in (HOSTILE, LONG):
            ask(text)
            detector.transition("configure")
            diagnose()
        detector.set_one_by_one(
            [Parameter(f"{MARK}\x1b[31m").to_parameter_msg()]
        )  # drops the one of the file
        detector.reset()
        detector.bring_to("inactive")
        for text in (HOSTILE, LONG):
            for name, value in (("classes", [text] * 3), ("weights", text)):
                detector.set_one_by_one([Parameter(name, value=value).to_parameter_msg()])
                assert not detector.transition("activate")
                diagnose()
                detector.reset()
                detector.bring_to("inactive")
        detector.bring_to("active")
        ask(HOSTILE)
        for count, text in enumerate((HOSTILE, LONG), start=1):
            header = Header(frame_id=text)
            detector.publish(Image(header=header, encoding=text, height=1, width=1, data=array("B", [0])))
            detector.wait_until_rejected(count)
            diagnose()
        compressed = detector.observer.create_publisher(CompressedImage, "/yolov5/image_raw/compressed", 1)
        assert detector.node.set_parameters(image_transport="compressed") == ""
        rejected = int(detector.status()["frames rejected"])

        def is_rejected() -> bool:
            compressed.publish(CompressedImage(header=Header(frame_id=HOSTILE), format=LONG, data=[1, 2]))
            return int(detector.status()["frames rejected"]) > rejected

        detector.observer.wait_for(is_rejected, "the rejected compressed image")
        diagnose()
        assert sum(MARK in text for text in told) > 20
        output = detector.process.output
    assert [found for text in told if (found := escaped(text))] == []
    assert all(line.isprintable() for line in output.split("\n"))
    assert not any(line.startswith("[INFO] [1.0]") for line in output.split("\n"))


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
