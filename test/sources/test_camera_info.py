"""The file at camera_info_url: what is read, and what is refused with which message."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.camera_info_file import FILE

from yolov5_lifecycle.sources.camera_info import MAX_FILE_BYTES, read_camera_info


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "my camera.yaml"
    path.write_text(FILE)
    return path


@pytest.mark.parametrize("quoted", [False, True])
def test_a_file_of_camera_calibration_is_read(path: Path, quoted: bool) -> None:
    known = read_camera_info(path.as_uri() if quoted else f"file://{path}")
    assert known.size_hw == (480, 640)
    assert list(known.camera_matrix.data) == [438.78, 0, 305.59, 0, 437.34, 243.74, 0, 0, 1]
    assert list(known.distortion_coefficients.data) == [-0.3615, 0.1661, 4.8e-05, 1e-05, 0]
    assert known.projection_matrix.data[5] == 393.66


@pytest.mark.long
@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        pytest.param(
            "[",
            "[1, ",
            "camera_matrix: expected 9 numbers, found 10; "
            "rectification_matrix: expected 9 numbers, found 10; "
            "projection_matrix: expected 12 numbers, found 13; "
            "distortion_coefficients: expected 4 or 5 numbers, found 6",
            id="one number more everywhere",
        ),
        pytest.param(
            "plumb_bob", "fisheye", "'plumb_bob', 'rational_polynomial' or 'equidistant'", id="model"
        ),
        pytest.param(
            "438.78", ".nan", "camera_matrix.data.0: Input should be a finite number", id="no number"
        ),
        pytest.param("438.78", "0", "expected focal lengths above 0", id="not calibrated"),
        pytest.param("437.34", "0", "expected focal lengths above 0", id="not calibrated in y"),
        pytest.param(
            "plumb_bob",
            "equidistant",
            "distortion_coefficients: expected 4 numbers, found 5",
            id="number of coefficients",
        ),
        pytest.param(FILE, "", "found no names and values", id="empty"),
        pytest.param(FILE, " " * MAX_FILE_BYTES + FILE, f"more than {MAX_FILE_BYTES} bytes", id="too large"),
    ],
)
def test_wrong_values_are_refused_with_the_reason(path: Path, old: str, new: str, told: str) -> None:
    assert old in FILE
    path.write_text(FILE.replace(old, new))
    with pytest.raises(ValueError, match=re.escape(f"{path}: ") + f".*{re.escape(told)}") as raised:
        read_camera_info(f"file://{path}")
    assert str(raised.value).isprintable()
    assert len(str(raised.value)) < 2000


@pytest.mark.parametrize(
    ("url", "told"),
    [
        pytest.param("file://lens.yaml", "expected file:///PATH", id="relative"),
        pytest.param("package://no_such/lens.yaml", "no package 'no_such'", id="package"),
        pytest.param("file:///no/such.yaml", "No such file", id="no file"),
        pytest.param("package://yolov5_lifecycle/no.yaml", "/no.yaml: No such file", id="of a package"),
        pytest.param("file:///dev/zero", "expected a regular file", id="device"),
        pytest.param("file:///", "found a folder", id="folder"),
    ],
)
def test_a_url_without_a_file_is_refused_with_the_reason(url: str, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        read_camera_info(url)
