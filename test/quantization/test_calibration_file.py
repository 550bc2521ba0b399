"""A calibration file is read as it was written; one that is damaged, hostile or foreign is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.calibrations import DIGEST, a_calibration, a_reference
from support.special_cache_files import SPECIAL_CACHE_FILES

from yolov5_lifecycle.quantization.calibration_file import (
    MAX_FILE_BYTES,
    CalibrationError,
    content_sha256,
    path_beside,
    read_calibration,
    write_calibration,
)

WEIGHTS = Path("/models/my best.pt")


def read(path: Path) -> object:
    return read_calibration(path, weights=WEIGHTS, weights_sha256=DIGEST)


def test_what_was_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "best.calibration.json"
    write_calibration(path, a_calibration())
    assert read(path) == a_calibration()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_it_is_stored_beside_the_weights() -> None:
    assert path_beside(WEIGHTS) == Path("/models/my best.calibration.json")


def test_a_measurement_is_found_by_runtime_and_precision() -> None:
    calibration = a_calibration()
    assert calibration.measurement("openvino", "int8") == calibration.measured[1]
    assert calibration.measurement("onnxruntime", "int8") is None


def test_one_of_other_weights_is_refused_with_the_command_that_makes_another(tmp_path: Path) -> None:
    path = tmp_path / "best.calibration.json"
    write_calibration(path, a_calibration(weights_sha256="12" * 32))
    with pytest.raises(CalibrationError, match=r"other weights.*calibrate '/models/my best.pt' DATA"):
        read(path)


def test_a_missing_one_is_refused_with_the_command_that_makes_it(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"calibration not found.*calibrate '/models/my best.pt' DATA"):
        read(tmp_path / "best.calibration.json")


def stored() -> dict[str, Any]:
    """What the file of a calibration holds."""
    fields: dict[str, Any] = json.loads(a_calibration().model_dump_json())
    return fields | {"content_sha256": content_sha256(a_calibration())}


def with_(**changed: object) -> Callable[[], bytes]:
    """The text of a calibration with other fields."""

    def text() -> bytes:
        return json.dumps(stored() | changed).encode()

    return text


def without(name: str) -> Callable[[], bytes]:
    def text() -> bytes:
        fields = stored()
        del fields[name]
        return json.dumps(fields).encode()

    return text


def of_one_tensor(low: object, high: object) -> Callable[[], bytes]:
    return with_(ranges={"x": [low, high]})


def of_one_layer(name: str, high: float) -> Callable[[], bytes]:
    """A calibration whose only change is the upper end of one range."""

    def text() -> bytes:
        fields = stored()
        fields["ranges"][name][1] = high
        return json.dumps(fields).encode()

    return text


REFERENCE = json.loads(a_reference().model_dump_json())
MEASURED = json.loads(a_calibration().measured[0].model_dump_json())
HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "EOF"),
    "cut off": (lambda: with_()()[:-40], "EOF|expected"),
    "no text": (lambda: b"\xff\xfe\x00", "Invalid JSON"),
    "a list": (lambda: b"[1, 2]", "object"),
    "deep lists": (lambda: b"[" * 100_000, "recursion"),
    "deep ranges": (lambda: b'{"ranges": ' + b'{"a": ' * 100_000, "recursion"),
    "another format": (with_(format="yolov5_lifecycle calibration 3"), "format"),
    "of a version without digest and reference": (
        with_(format="yolov5_lifecycle calibration 1"),
        "format: Input should be 'yolov5_lifecycle calibration 2'",
    ),
    "an unknown field": (with_(run="rm -rf ~"), "run: Extra inputs"),
    "no ranges at all": (without("ranges"), "ranges: Field required"),
    "no tensors": (with_(ranges={}), "ranges"),
    "no digest": (with_(weights_sha256="best"), "weights_sha256"),
    "a digest and a line": (with_(weights_sha256=DIGEST + "\n"), "weights_sha256"),
    "a digest that is a number": (with_(weights_sha256=5), "weights_sha256: Input should be a valid string"),
    "ranges as a list": (with_(ranges=[[0, 1]]), "ranges"),
    "a range of one number": (with_(ranges={"x": [1.0]}), "ranges.x"),
    "a range of three numbers": (with_(ranges={"x": [0.0, 1.0, 2.0]}), "ranges.x"),
    "a range of words": (of_one_tensor("0", "1"), "ranges.x.0"),
    "not a number": (of_one_tensor(0.0, float("nan")), "ranges.x.1"),
    "infinite": (of_one_tensor(0.0, float("inf")), "ranges.x.1"),
    "beyond every float": (lambda: with_()().replace(b"6.5", b"1e999"), r"ranges.model\.1\.conv.1"),
    "a huge number": (of_one_tensor(0.0, 1e30), "ranges.x.1"),
    "an integer without end": (lambda: with_()().replace(b"6.5", b"9" * 10_000), "number out of range"),
    "of zero width": (of_one_tensor(0.0, 0.0), r"expected \[low, high\] with low <= 0 <= high"),
    "upside down": (of_one_tensor(1.0, -1.0), r"expected \[low, high\] with low <= 0 <= high"),
    "without zero": (of_one_tensor(1.0, 2.0), r"expected \[low, high\] with low <= 0 <= high"),
    "true as a number": (of_one_tensor(False, True), "ranges.x"),
    "a nameless tensor": (with_(ranges={"": [0.0, 1.0]}), "ranges"),
    "a long name": (with_(ranges={"x" * 1000: [0.0, 1.0]}), "ranges"),
    "too many tensors": (with_(ranges={f"t{i}": [0.0, 1.0] for i in range(10_001)}), "ranges"),
    "weights of 3 bits": (with_(weight_bits=3), "weight_bits"),
    "without its own digest": (without("content_sha256"), "content_sha256: Field required"),
    "a changed range": (of_one_layer("model.1.conv", 6.4), "does not match its own digest"),
    "a changed mean": (lambda: with_()().replace(b"0.4, 0.5", b"0.4, 0.6"), "does not match its own digest"),
    "a changed measurement": (
        with_(measured=[MEASURED | {"agreement_f1": 0.999}]),
        "does not match its own digest",
    ),
    "means far outside the range": (
        with_(means={"model.0.conv": [1e9, 0.5, 0.5], "model.1.conv": [0.1, 0.2]}),
        "'model.0.conv': expected means near the range, 0 to 1",
    ),
    "no reference": (without("reference"), "reference: Field required"),
    "a reference that is no base64": (with_(reference=REFERENCE | {"rgb": "@@@@"}), "expected base64"),
    "a reference that is no ASCII": (with_(reference=REFERENCE | {"rgb": "\u00e9" * 4}), "expected base64"),
    "a reference with too few pixels": (
        with_(reference=REFERENCE | {"rgb": "AAAA"}),
        "expected 192 bytes of pixels, found 3",
    ),
    "a huge reference": (with_(reference=REFERENCE | {"size_hw": [100_000, 100_000]}), "size_hw"),
    "a long reference": (with_(reference=REFERENCE | {"rgb": "A" * 100_000}), "reference.rgb"),
    "a reference with no noise at all": (with_(reference=REFERENCE | {"noise": []}), "reference.noise"),
    "a reference with negative noise": (with_(reference=REFERENCE | {"noise": [-1.0]}), "reference.noise"),
    "an image size of 0": (with_(image_size=0), "image_size"),
    "an agreement above 1": (with_(measured=[MEASURED | {"agreement_f1": 2.0}]), "agreement_f1"),
    "no time at all": (with_(measured=[MEASURED | {"ms_per_image": 0.0}]), "ms_per_image"),
    "an unknown runtime": (with_(measured=[MEASURED | {"runtime": "sh"}]), "runtime"),
    "measured twice": (with_(measured=[MEASURED, MEASURED]), "each runtime and precision once"),
    "control characters": (with_(**{"\x1b[31mred": 1}), "Extra inputs"),
    "too large": (lambda: b" " * (MAX_FILE_BYTES + 1), "the limit"),
}


@pytest.mark.parametrize(("content", "reason"), HOSTILE.values(), ids=HOSTILE)
def test_a_file_that_holds_no_calibration_is_refused(
    content: Callable[[], bytes], reason: str, tmp_path: Path
) -> None:
    path = tmp_path / "best.calibration.json"
    path.write_bytes(content())
    with pytest.raises(CalibrationError, match=reason) as refusal:
        read(path)
    told = str(refusal.value)
    assert told.startswith(f"{path}: this is not a usable calibration: ")
    assert "calibrate '/models/my best.pt' DATA" in told
    assert told.isprintable()
    assert len(told) < 600 + len(str(path))


@pytest.mark.parametrize("make", SPECIAL_CACHE_FILES.values(), ids=SPECIAL_CACHE_FILES)
def test_what_is_no_small_regular_file_is_refused_at_once(
    make: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "best.calibration.json"
    make(path)
    with pytest.raises(CalibrationError, match="not a usable calibration"):
        read(path)
