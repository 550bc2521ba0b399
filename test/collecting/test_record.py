"""Lines of `frames.jsonl`, which anybody may have written."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.candidates import RECORD, look_of

from yolov5_lifecycle.collecting.record import (
    MAX_RECORD_BYTES,
    CollectedFrame,
    FrameLine,
    RecordError,
    embedding_text,
)

LINE = FrameLine.of(RECORD).text


def test_a_record_is_one_line_that_reads_back() -> None:
    line = FrameLine.of(RECORD)
    assert LINE.count(b"\n") == 1
    assert line.frame == RECORD
    assert line.labels == "labels/20261124T070343Z-0a1b2c/000001_front.txt"
    assert line.session == "20261124T070343Z-0a1b2c"


def changed(**values: Any) -> bytes:
    return json.dumps(json.loads(LINE) | values).encode() + b"\n"


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b"{}\n", id="nothing in it"),
        pytest.param(LINE[:50], id="torn"),
        pytest.param(LINE[:-1], id="without its end"),
        pytest.param(b" " * MAX_RECORD_BYTES + LINE, id="too long"),
        pytest.param(b"\xff\xfe\n", id="no UTF-8"),
        pytest.param(changed(image="images/../../etc/1.jpg"), id="another folder"),
        pytest.param(changed(image="/images/drive/000001.jpg"), id="an absolute path"),
        pytest.param(changed(image="images/drive/000001.jpg\n"), id="a line break"),
        pytest.param(changed(image="images/drive/000001_" + "a" * 99 + ".jpg"), id="a long name"),
        pytest.param(changed(value=float("nan")), id="no number"),
        pytest.param(changed(unknown=1), id="another field"),
        pytest.param(changed(embedding="%"), id="no base64"),
        pytest.param(changed(embedding="AA=="), id="half a number"),
        pytest.param(changed(embedding="/38="), id="an embedding that is NaN"),
        pytest.param(changed(shades="AAAA"), id="too few shades"),
        pytest.param(changed(shades="%"), id="shades that are no base64"),
    ],
)
def test_what_is_no_record_is_refused(line: bytes) -> None:
    with pytest.raises(RecordError):
        CollectedFrame.of_line(line)


@pytest.mark.parametrize("value", [b"0", b"[]", b"{}"])
def test_a_line_is_refused_before_its_many_values_are_built(value: bytes) -> None:
    line = LINE[:-2] + b', "objects": [' + b",".join([value] * 300_001) + b"]}\n"
    with pytest.raises(RecordError, match="at most 300000 values, lists and objects"):
        CollectedFrame.of_line(line)


def embedding_of(text: str) -> NDArray[np.float32]:
    return RECORD.model_copy(update={"embedding": text}).descriptor()[0]


def test_an_embedding_keeps_its_direction() -> None:
    wanted = look_of(1) * 1000
    stored = embedding_of(embedding_text(wanted))
    assert np.linalg.norm(stored) == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(stored, wanted / np.linalg.norm(wanted), atol=1e-3)


@pytest.mark.parametrize("value", [0, np.nan, np.inf])
def test_an_embedding_without_direction_is_empty(value: float) -> None:
    assert embedding_of(embedding_text(np.full(4, value, np.float32))).shape == (0,)
