"""A file for camera_info_url, as camera_calibration writes it."""

from __future__ import annotations

from pathlib import Path

FILE = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.78, 0., 305.59, 0., 437.34, 243.74, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.3615, 0.1661, 4.8e-05, 1e-05, 0.]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.66, 0, 322.8, 0, 0, 393.66, 241.1, 0, 0, 0, 1, 0]
"""


def camera_info_url(folder: Path, width: int, height: int) -> str:
    """URL of a new file in `folder` for images of this size."""
    path = folder / "lens.yaml"
    path.write_text(FILE.replace("640", str(width), 1).replace("480", str(height), 1))
    return f"file://{path}"
