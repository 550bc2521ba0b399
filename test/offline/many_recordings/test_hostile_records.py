"""Records that the folder of results claims to be those of `detect_bag`: an invalid one counts as none."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.detected_offline import SET_MODEL
from support.many_recordings import Notes, ScriptedWorkers, plan_for, record_drives
from support.special_cache_files import SPECIAL_CACHE_FILES

from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.many_recordings.finished import RECORD_NAME, Record, file_stamps, read_record
from yolov5_lifecycle.offline.many_recordings.plan import Plan
from yolov5_lifecycle.offline.many_recordings.recording_result import RecordingResult
from yolov5_lifecycle.offline.many_recordings.recordings_terminal import recordings_report
from yolov5_lifecycle.offline.many_recordings.supervisor import Tally, detect_recordings
from yolov5_lifecycle.offline.many_recordings.workers import Ended, Event, Ready, Refused
from yolov5_lifecycle.offline.recordings import SourceRecording, recordings_of
from yolov5_lifecycle.offline.terminal import objects_line

FORGED = "\x1b[2K\rERROR: the disk is full"


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_drives(tmp_path_factory.mktemp("recorded") / "drives", {"east": 1, "west": 1})


def record_of(drives: Path, output: Path) -> dict[str, Any]:
    """A valid record of east, whose result is one file in `output`."""
    folder = output / "east"
    folder.mkdir(parents=True)
    (folder / "east.mcap").write_bytes(b"1234")
    plan = plan_for(output)
    row = RecordingResult(
        recording="east", path="/east", state="done", images=1, detected=1, detections={"circle": 1}
    )
    record = Record(
        weights_sha256=plan.weights_sha256,
        settings_sha256=plan.settings_sha256,
        recording_sha256="ab" * 32,
        recording_files=file_stamps(drives / "east"),
        result_bytes={"east.mcap": 4},
        result=row,
    )
    record.write(folder)
    fields: dict[str, Any] = json.loads((folder / RECORD_NAME).read_text())
    return fields


def changed(**fields: object) -> Callable[[dict[str, Any]], bytes]:
    return lambda record: json.dumps(record | fields).encode()


def with_row(**fields: object) -> Callable[[dict[str, Any]], bytes]:
    return lambda record: json.dumps(record | {"result": record["result"] | fields}).encode()


def without(name: str) -> Callable[[dict[str, Any]], bytes]:
    return lambda record: json.dumps({key: value for key, value in record.items() if key != name}).encode()


HOSTILE: dict[str, Callable[[dict[str, Any]], bytes]] = {
    "empty": lambda _: b"",
    "cut off": lambda record: json.dumps(record).encode()[:-9],
    "no text": lambda _: b"\xff\xfe\x00",
    "a list": lambda _: b"[]",
    "deep lists": lambda _: b"[" * 1_000_000,
    "deep objects": lambda _: b'{"result": ' + b'{"a": ' * 100_000,
    "another recording": with_row(recording="west"),
    "no recording": with_row(recording=""),
    "a recording that is no text": lambda record: json.dumps(record).replace('"east"', '"\\ud800"').encode(),
    "a huge count": with_row(images=10**30, detected=10**30),
    "beyond 64 bits": with_row(images=1 << 63, detected=1 << 63),
    "a number without end": lambda record: (
        json.dumps(record).replace('"images": 1', '"images": ' + "9" * 10_000).encode()
    ),
    "a negative count": with_row(detected=-5),
    "true as a number": with_row(images=True),
    "a number as text": with_row(images="1"),
    "more detected than images": with_row(detected=2),
    "not a number": with_row(seconds=float("nan")),
    "infinite": with_row(seconds=float("inf")),
    "negative time": with_row(seconds=-1.0),
    "class names with escapes": with_row(detections={FORGED: 1}),
    "class names of two lines": with_row(detections={"cat\nERROR: no": 1}),
    "class names that turn the text": with_row(detections={"\u202ecat": 1}),
    "a long class name": with_row(detections={"x" * 201: 1}),
    "a class without a name": with_row(detections={"": 1}),
    "too many classes": with_row(detections={f"c{number}": 1 for number in range(10_001)}),
    "a huge number of objects": with_row(detections={"cat": 10**30}),
    "a negative number of objects": with_row(detections={"cat": -1}),
    "a long problem": with_row(first_problem="x" * 10_001),
    "a row that is not done": with_row(state="set aside"),
    "an unknown state": with_row(state="fine"),
    "a row with something else": with_row(run="rm -rf ~"),
    "something else": changed(run="rm -rf ~"),
    "no row": without("result"),
    "no digest": changed(weights_sha256="best"),
    "no files": changed(result_bytes={}),
    "a negative size": changed(result_bytes={"east.mcap": -4}),
    "too large": lambda record: json.dumps(record).encode() + b" " * (16 << 20),
}


@pytest.mark.parametrize("spoil", HOSTILE.values(), ids=HOSTILE)
def test_an_invalid_record_counts_as_none(
    spoil: Callable[[dict[str, Any]], bytes], drives: Path, tmp_path: Path
) -> None:
    record = record_of(drives, tmp_path)
    assert read_record(tmp_path / "east") is not None
    (tmp_path / "east" / RECORD_NAME).write_bytes(spoil(record))
    assert read_record(tmp_path / "east") is None


@pytest.mark.parametrize("make", SPECIAL_CACHE_FILES.values(), ids=SPECIAL_CACHE_FILES)
def test_a_record_that_is_no_small_file_counts_as_none(
    make: Callable[[Path], object], tmp_path: Path
) -> None:
    (tmp_path / "east").mkdir()
    make(tmp_path / "east" / RECORD_NAME)
    assert read_record(tmp_path / "east") is None


class OneRow:
    """A worker that gives every recording the same row."""

    def __init__(self) -> None:
        self.workers = ScriptedWorkers(1, self._ready, self._done)

    def _ready(self, worker: int, plan: Plan) -> Event:
        return Ready(worker, "torch", "fp32")

    def _done(self, worker: int, source: SourceRecording) -> Event:
        row = RecordingResult(recording=source.name, path=str(source.path), state="done", images=1)
        return Ended(worker, row)


def run(drives: Path, output: Path, workers: ScriptedWorkers) -> Tally:
    sources = recordings_of([drives], output)
    return detect_recordings(sources, plan_for(output), new_workers=lambda _: workers, watch=Notes())


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(with_row(detections={FORGED: 1}), id="class names with escapes"),
        pytest.param(with_row(images=10**30, detected=10**30), id="a huge count"),
        pytest.param(with_row(recording="west"), id="another recording"),
    ],
)
def test_the_recording_of_an_invalid_record_is_handed_out_again(
    spoil: Callable[[dict[str, Any]], bytes], drives: Path, tmp_path: Path
) -> None:
    record = record_of(drives, tmp_path)
    one = OneRow()
    assert run(drives, tmp_path, one.workers).in_state("skipped") == 1
    assert [name for _, name in one.workers.begun] == ["west"]
    (tmp_path / "east" / RECORD_NAME).write_bytes(spoil(record))
    again = OneRow()
    assert run(drives, tmp_path, again.workers).in_state("done") == 2
    assert [name for _, name in again.workers.begun] == ["east", "west"]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [row["recording"] for row in summary["results"]] == ["east", "west"]


def test_the_old_summary_stays_until_the_new_one_is_whole(drives: Path, tmp_path: Path) -> None:
    run(drives, tmp_path, OneRow().workers)
    before = {path.name: path.read_bytes() for path in tmp_path.glob("summary.*")}
    assert before
    refusing = ScriptedWorkers(1, lambda worker, _: Refused(worker, "no memory"), OneRow()._done)
    with pytest.raises(DetectingError, match="no memory"):
        run(drives, tmp_path, refusing)
    assert {path.name: path.read_bytes() for path in tmp_path.glob("summary.*")} == before


def test_neither_file_of_the_old_summary_is_replaced_if_one_of_the_new_cannot_be(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    run(drives, tmp_path, OneRow().workers)
    before = {path.name: path.read_bytes() for path in tmp_path.glob("summary.*")}
    synchronised: Counter[str] = Counter()

    def full(descriptor: int) -> None:
        synchronised["files"] += 1
        if synchronised["files"] == 2:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        run(drives, tmp_path, OneRow().workers)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.long
def test_a_forged_record_reaches_neither_terminal_nor_summary(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = record_of(drives, tmp_path)
    (tmp_path / "east" / RECORD_NAME).write_bytes(with_row(detections={FORGED: 1})(record))
    assert main([str(drives), "--output", str(tmp_path), *SET_MODEL]) == 3
    told = capsys.readouterr()
    assert all(line.isprintable() for line in (told.out + told.err).splitlines())
    assert "east: set aside: " in told.err
    assert "the disk is full" not in told.err + (tmp_path / "summary.json").read_text()


def test_names_in_a_report_are_one_line_without_escapes() -> None:
    line = objects_line(Counter({FORGED: 2, "a\nb": 1, "\u202eabc": 1}))
    assert line.count("\n") == 1
    assert line.rstrip("\n").isprintable()
    assert len(objects_line(Counter({"x" * 200 + str(number): 1 for number in range(10_000)}))) < 10_100
    assert recordings_report(Tally(0)).count("\n") == 4
