"""Calibrations for tests."""

from __future__ import annotations

from yolov5_lifecycle.quantization.calibration_file import Calibration


def a_calibration() -> Calibration:
    """A valid one, of nothing in particular."""
    return Calibration(
        weights_sha256="ab" * 32,
        image_size=320,
        ranges={"model.0.conv": (0.0, 1.0), "model.1.conv": (-0.278, 6.5)},
        means={"model.0.conv": (0.4, 0.5, 0.5), "model.1.conv": (0.1, 0.2)},
        fp32_layers=("model.1.conv",),
    )
