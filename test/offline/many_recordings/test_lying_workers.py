"""What a worker answers is checked: nonsense costs that worker its life, and never the whole run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.many_recordings import Notes, plan_for

from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.many_recordings.answers import (
    MAX_BYTES,
    AnswerError,
    encoded,
    read_answer,
    refusal,
)
from yolov5_lifecycle.offline.many_recordings.recording_result import RecordingResult
from yolov5_lifecycle.offline.many_recordings.supervisor import Tally, detect_recordings
from yolov5_lifecycle.offline.many_recordings.worker_pool import ProcessWorkers
from yolov5_lifecycle.offline.recordings import SourceRecording

ROW = RecordingResult(recording="east", path="/drives/east", state="done", images=2, detected=2).model_dump()
EVERY_KIND = frozenset({"ready", "refused", "progress", "ended"})


def row(**changed: object) -> str:
    return json.dumps({"ended": ROW | changed})


LIES = {
    "no JSON": "ready",
    "nothing": "",
    "a list": "[1, 2]",
    "no answer": "{}",
    "null": '{"ended": null}',
    "two answers": '{"progress": 1, "refused": "no"}',
    "an unknown answer": '{"restart": true}',
    "nested without end": '{"ended": ' + "[" * 100_000,
    "a negative number of images": '{"progress": -1}',
    "true as a number": '{"progress": true}',
    "a fraction of an image": '{"progress": 1.5}',
    "a number without end": '{"progress": ' + "9" * 10_000 + "}",
    "a huge number": '{"progress": ' + str(10**30) + "}",
    "a runtime with escapes": '{"ready": ["\\u001b[31m", "fp32"]}',
    "one word": '{"ready": ["torch"]}',
    "a lone surrogate": '{"refused": "\\ud800"}',
    "a long reason": json.dumps({"refused": "x" * 10_001}),
    "a row with a huge count": row(images=10**30, detected=10**30),
    "a row with a negative count": row(failed=-1),
    "a row that does not add up": row(detected=3),
    "a row without a number": row(seconds=float("nan")),
    "a row of another recording": row(recording="west"),
    "a row with an unknown state": row(state="fine"),
    "a row with class names that have escapes": row(detections={"\x1b[2Jcat": 1}),
    "a row with something else": row(shell="rm -rf ~"),
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_an_answer_that_is_none_is_refused_in_one_line(lie: str) -> None:
    with pytest.raises(AnswerError, match="the worker answered") as refused:
        read_answer(lie, expected=EVERY_KIND, recording="east")
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 1100


@pytest.mark.parametrize(
    ("answer", "kind"),
    [
        ('{"ready": ["openvino", "int8"]}', "ready"),
        ('{"progress": 0}', "progress"),
        ('{"refused": ""}', "refused"),
        (row(), "ended"),
    ],
)
def test_an_answer_is_read_if_it_was_asked(answer: str, kind: str) -> None:
    assert read_answer(answer, expected=EVERY_KIND, recording="east").kind == kind
    with pytest.raises(AnswerError, match=f"'{kind}', which was not asked"):
        read_answer(answer, expected=EVERY_KIND - {kind}, recording="east")


def test_a_refusal_is_an_answer_whatever_the_error_says() -> None:
    told = encoded(refusal(ValueError("\udcff\x1b[31m" + "x" * 100_000)))
    answer = read_answer(told, expected=EVERY_KIND, recording=None)
    assert answer.refused is not None
    assert answer.refused.startswith("??[31mx")


def run(folder: Path, notes: Notes) -> Tally:
    sources = [SourceRecording(name, folder / name) for name in ("east", "west")]
    return detect_recordings(
        sources,
        plan_for(folder / "found", runtime="torch", precision="fp32"),
        new_workers=lambda _: ProcessWorkers(1, module="support.lying_worker"),
        watch=notes,
    )


@pytest.mark.long
@pytest.mark.parametrize(
    "lie",
    [
        pytest.param("no JSON", id="no JSON"),
        pytest.param(row(recording="north"), id="another recording"),
        pytest.param('{"ready": ["torch", "fp32"]}', id="ready again"),
        pytest.param(f"repeat x {MAX_BYTES + (1 << 20)}", id="a line without end"),
        pytest.param(f"{row()}\n{row()}", id="the same row twice"),
    ],
)
def test_a_worker_that_lies_about_a_recording_is_ended_and_the_recording_set_aside(
    lie: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LIE_WHILE_RUNNING", lie)
    notes = Notes()
    tally = run(tmp_path, notes)
    assert tally.in_state("set aside") == 2
    assert [remark.split(":")[0] for remark in notes.aside] == ["east", "west"]
    assert all("the worker answered" in remark for remark in notes.aside)
    summary = json.loads((tmp_path / "found" / "summary.json").read_text())
    assert (summary["set_aside"], summary["images"]) == (2, 0)


def test_a_worker_that_lies_while_it_loads_ends_the_run_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LIE_WHILE_LOADING", '{"ended": {}}')
    with pytest.raises(DetectingError, match=r"the worker answered.*while loading the model, 2 times"):
        run(tmp_path, Notes())
