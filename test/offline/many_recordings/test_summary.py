"""The summary of many recordings: whole or as it was before, and what the terminal shows of it."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import pytest
from support.many_recordings import Notes, ScriptedWorker, done, loaded, plan_for

from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.many_recordings.results import Refused
from yolov5_lifecycle.offline.many_recordings.supervisor import detect_recordings
from yolov5_lifecycle.offline.many_recordings.tally import Tally, recordings_report
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.offline.terminal import objects_line

FORGED = "\x1b[2K\rERROR: the disk is full"


def run(output: Path, worker: ScriptedWorker) -> Tally:
    sources = [SourceRecording(name, Path("/drives", name)) for name in ("east", "west")]
    return detect_recordings(sources, plan_for(output), new_workers=lambda _: [worker], terminal=Notes())


def test_the_old_summary_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    run(tmp_path, ScriptedWorker(loaded, done))
    before = {path.name: path.read_bytes() for path in tmp_path.glob("summary.*")}
    assert before
    refusing = ScriptedWorker(lambda *_: Refused("no memory"), done)
    with pytest.raises(DetectingError, match="no memory"):
        run(tmp_path, refusing)
    assert {path.name: path.read_bytes() for path in tmp_path.glob("summary.*")} == before


def test_neither_file_of_the_old_summary_is_replaced_if_one_of_the_new_cannot_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    run(tmp_path, ScriptedWorker(loaded, done))
    before = {path.name: path.read_bytes() for path in tmp_path.glob("summary.*")}
    synchronised: Counter[str] = Counter()

    def full(descriptor: int) -> None:
        synchronised["files"] += 1
        if synchronised["files"] == 2:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        run(tmp_path, ScriptedWorker(loaded, done))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_names_in_a_report_are_one_line_without_escapes() -> None:
    line = objects_line(Counter({FORGED: 2, "a\nb": 1, "\u202eabc": 1}))
    assert line.count("\n") == 1
    assert line.rstrip("\n").isprintable()
    assert len(objects_line(Counter({"x" * 200 + str(number): 1 for number in range(10_000)}))) < 10_100
    assert recordings_report(Tally(0)).count("\n") == 4
