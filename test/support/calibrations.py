"""Calibrations for tests."""

from __future__ import annotations

import base64
import json
from pathlib import Path

from yolov5_lifecycle.quantization.calibration_file import Calibration, Measurement, read_calibration
from yolov5_lifecycle.quantization.reference import Reference

DIGEST = "ab" * 32


def a_calibration(**changed: object) -> Calibration:
    """A valid one, of nothing in particular; `changed` replaces fields."""
    fields: dict[str, object] = {
        "weights_sha256": DIGEST,
        "data_sha256": "ef" * 32,
        "images": 40,
        "image_size": 320,
        "confidence_threshold": 0.25,
        "iou_threshold": 0.45,
        "weight_bits": 8,
        "ranges": {"model.0.conv": (0.0, 1.0), "model.1.conv": (-0.278, 6.5)},
        "means": {"model.0.conv": (0.4, 0.5, 0.5), "model.1.conv": (0.1, 0.2)},
        "fp32_layers": ("model.1.conv",),
        "reference": a_reference(),
        "detections": 120,
        "measured": (measurement("fp32", 20.0, 1.0), measurement("int8", 10.0, 0.99)),
        "computer_sha256": "cd" * 32,
        "processor": "A processor",
        "abilities": ("avx2", "avx512_vnni"),
        "versions": {"openvino": "2026.1"},
    }
    return Calibration(**fields | changed)  # type: ignore[arg-type]


def a_reference() -> Reference:
    """A grey image of 8x8 pixels, for a network of three levels."""
    grey = base64.b64encode(bytes([114] * 192)).decode()
    return Reference(size_hw=(8, 8), rgb=grey, noise=(0.01, 0.01, 0.01))


def calibration_at(path: Path) -> Calibration:
    """The calibration at `path`, whatever weights it belongs to."""
    digest = json.loads(path.read_text())["weights_sha256"]
    return read_calibration(path, weights=path, weights_sha256=digest)


def measurement(precision: str, ms_per_image: float, agreement_f1: float) -> Measurement:
    """One of OpenVINO."""
    return Measurement(
        runtime="openvino",
        precision=precision,  # type: ignore[arg-type]
        ms_per_image=ms_per_image,
        processor_ms_per_image=2 * ms_per_image,
        agreement_f1=agreement_f1,
        box_iou=0.97,
    )
