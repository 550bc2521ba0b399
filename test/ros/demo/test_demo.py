"""`make demo`: the command as a user runs it."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from yolov5_lifecycle.ros.demo.child_process import ChildProcess, ProcessError, entry_point
from yolov5_lifecycle.ros.demo.command import main, table
from yolov5_lifecycle.ros.demo.demonstration import Phase, longest_gap_s
from yolov5_lifecycle.ros.demo.ground_truth import Sighting, pairwise_iou, recall
from yolov5_lifecycle.ros.demo.observer import PATIENCE_S

NO_BOXES = np.zeros((0, 4))


def sighting(*objects: tuple[str, tuple[float, ...]], stamp_ns: int = 0, latency_ms: float = 0.0) -> Sighting:
    names = tuple(name for name, _ in objects)
    boxes = np.array([box for _, box in objects], np.float64).reshape(-1, 4)
    return Sighting(stamp_ns, latency_ms, names, (0.9,) * len(names), boxes)


@pytest.mark.end_to_end
def test_the_demo_passes_and_leaves_its_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with ChildProcess("demo", [entry_point("demo")], os.environ) as demo:
        code = demo.wait(250.0)
    lines = demo.output.splitlines()
    assert code == 0, demo.output
    assert lines[-1].startswith("demo ok: ")
    assert any("] mask IoU " in line for line in lines)
    assert any(line.startswith("all classes") for line in lines)
    drawn = cv2.imread(str(tmp_path / "build" / "demo" / "annotated.png"))
    assert drawn is not None
    assert drawn.shape == (480, 640, 3)


def test_the_demo_says_why_it_cannot_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "build").write_text("a file where a folder should be")
    with ChildProcess("demo", [entry_point("demo")], os.environ) as demo:
        assert demo.wait(PATIENCE_S) == 1
    assert demo.output.startswith("demo failed: ")
    assert "Traceback" not in demo.output


def test_the_demo_explains_itself(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    assert "usage: demo" in capsys.readouterr().out


def test_a_word_that_the_demo_does_not_know_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["fast"])
    assert ended.value.code == 2
    assert "unrecognized arguments: fast" in capsys.readouterr().err


@pytest.mark.long
def test_the_end_of_the_demo_ends_what_it_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with ChildProcess("demo", [entry_point("demo")], os.environ) as demo:
        demo.wait_for_output("started as processes", PATIENCE_S)
        started = [int(word) for word in demo.output.splitlines()[0].split() if word.isdigit()]
        assert demo.stop(signal.SIGTERM) == 143
    assert len(started) == 2
    assert not any(Path(f"/proc/{process_id}").exists() for process_id in started)


def test_a_process_that_ends_too_early_is_reported_with_its_last_words() -> None:
    program = "import sys; print('first'); sys.exit('out of coffee')"
    with ChildProcess("coffee machine", [sys.executable, "-c", program], os.environ) as process:
        assert process.wait(PATIENCE_S) == 1
        with pytest.raises(ProcessError, match=r"coffee machine ended with exit code 1[^$]*out of coffee"):
            process.check_running()


def test_a_process_that_does_not_end_is_reported_and_killed() -> None:
    ignore = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN)"
    program = f"{ignore}; print('ready', flush=True); time.sleep(60)"
    with ChildProcess("mule", [sys.executable, "-c", program], os.environ) as process:
        process.wait_for_output("ready", PATIENCE_S)
        with pytest.raises(ProcessError, match=r"mule did not end within 0\.1 s"):
            process.stop(signal.SIGTERM, timeout_s=0.1)
    assert not Path(f"/proc/{process.process_id}").exists()


def test_boxes_overlap_by_their_shared_area() -> None:
    boxes = np.array([[0, 0, 2, 2], [1, 0, 3, 2], [5, 5, 6, 6], [1, 1, 1, 1]], np.float64)
    expected = np.array([[1, 1 / 3, 0, 0], [1 / 3, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]])
    assert np.allclose(pairwise_iou(boxes, boxes), expected)
    assert pairwise_iou(boxes, NO_BOXES).shape == (4, 0)


def test_an_object_is_found_by_a_box_of_its_class_in_its_place() -> None:
    truth = sighting(("circle", (0, 0, 10, 10)), ("star", (20, 0, 30, 10)), ("square", (40, 0, 50, 10)))
    seen = sighting(("circle", (1, 0, 10, 10)), ("circle", (20, 0, 30, 10)), ("square", (46, 0, 56, 10)))
    assert seen.found_of(truth) == 1
    assert sighting().found_of(truth) == 0
    assert truth.found_of(sighting()) == 0


def test_recall_counts_the_objects_of_images_with_a_truth() -> None:
    truth = sighting(("circle", (0, 0, 10, 10)), ("star", (20, 0, 30, 10)))
    half = sighting(("circle", (0, 0, 10, 10)), stamp_ns=1)
    unknown = sighting(("circle", (0, 0, 10, 10)), stamp_ns=9)
    assert recall([half, unknown], {1: truth}) == 0.5
    assert np.isnan(recall([unknown], {1: truth}))


def test_the_longest_gap_lies_between_arrivals() -> None:
    arrivals_s = (0.0, 0.1, 0.5, 0.6)
    seen = [sighting(stamp_ns=0, latency_ms=arrival_s * 1e3) for arrival_s in arrivals_s]
    assert longest_gap_s(seen) == pytest.approx(0.4)
    assert longest_gap_s(seen[:1]) == 0.0


def test_the_table_has_a_row_per_phase() -> None:
    seen = tuple(sighting(("circle", (0, 0, 1, 1)), latency_ms=latency) for latency in (10.0, 20.0, 90.0))
    lines = table([Phase("first", seen, 0.5), Phase("second", seen)]).split("\n")
    assert lines[3].split() == ["first", "3", "3", "0", "0", "0", "50.0%", "20.0", "20.0"]
    assert lines[4].split() == ["second", "3", "3", "0", "0", "0", "20.0", "20.0"]
