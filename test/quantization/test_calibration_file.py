"""A calibration file is read as it was written; one that is damaged, huge or no calibration is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from support.calibrations import a_calibration

from yolov5_lifecycle.quantization.calibration_file import (
    MAX_FILE_BYTES,
    path_beside,
    read_calibration,
    write_calibration,
)
from yolov5_lifecycle.runtimes.quantization import QuantizationError


def test_what_was_written_is_read(tmp_path: Path) -> None:
    path = path_beside(tmp_path / "my best.pt")
    write_calibration(path, a_calibration())
    assert read_calibration(path) == a_calibration()
    assert [file.name for file in tmp_path.iterdir()] == ["my best.calibration.json"]


def with_(**changed: object) -> Callable[[], bytes]:
    """The text of a calibration with other fields."""
    fields = json.loads(a_calibration().model_dump_json()) | changed
    return lambda: json.dumps(fields).encode()


def of_one_layer(low: object, high: object) -> Callable[[], bytes]:
    return with_(ranges={"x": [low, high]})


DAMAGED: dict[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "EOF"),
    "another format": (with_(format="yolov5_lifecycle calibration 4"), "format"),
    "version 2": (with_(format="yolov5_lifecycle calibration 2", weight_bits=8, measured=[]), "format"),
    "not a number": (of_one_layer(0.0, float("nan")), "ranges.x.1"),
    "of zero width": (of_one_layer(0.0, 0.0), r"expected \[low, high\] with low <= 0 <= high"),
    "upside down": (of_one_layer(1.0, -1.0), r"expected \[low, high\] with low <= 0 <= high"),
    "means of other layers": (with_(means={"x": [0.5]}), "means: expected those of the same convolutions"),
    "control characters": (with_(format="\x1b[31mred"), "format"),
    "too large": (lambda: b" " * (MAX_FILE_BYTES + 1), "the limit"),
}


@pytest.mark.parametrize(("content", "reason"), DAMAGED.values(), ids=DAMAGED)
def test_a_file_that_holds_no_calibration_is_refused(
    content: Callable[[], bytes], reason: str, tmp_path: Path
) -> None:
    path = tmp_path / "best.calibration.json"
    path.write_bytes(content())
    with pytest.raises(
        QuantizationError, match=f"^this is not a usable calibration: .*({reason})"
    ) as refusal:
        read_calibration(path)
    assert str(refusal.value).isprintable()
    assert len(str(refusal.value)) < 300


def test_a_link_to_itself_is_no_calibration(tmp_path: Path) -> None:
    path = tmp_path / "best.calibration.json"
    path.symlink_to(path)
    with pytest.raises(QuantizationError, match="not a usable calibration: it cannot be read"):
        read_calibration(path)
