"""Parameter files as people write them, given to the installed detector."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import torch
from support.detector_process import (
    PARAMETERS,
    WEIGHTS,
    detector_process,
    parameter_file,
)

from yolov5_lifecycle.ros.observer import PATIENCE_S
from yolov5_lifecycle.sources.scene import CLASS_NAMES


@pytest.mark.long
@pytest.mark.parametrize(
    ("classes", "meant", "found"),
    [
        ("[]", [], CLASS_NAMES),
        ("[0, 2]", ["0", "2"], ("circle", "triangle")),
        ("[circle]", ["circle"], ("circle",)),
    ],
)
def test_a_parameter_file_is_taken_as_it_is_meant(
    tmp_path: Path, classes: str, meant: list[str], found: tuple[str, ...]
) -> None:
    text = f"weights: {WEIGHTS}\nimage_size: 320\nconfidence_threshold: 1\ndevice: 0\nclasses: {classes}"
    with detector_process(*parameter_file(tmp_path, text)) as detector:
        detector.bring_to("inactive")
        assert detector.node.parameter("confidence_threshold") == 1.0
        assert detector.node.parameter("classes") == meant
        if not torch.cuda.is_available():
            assert not detector.transition("activate")
            problem = detector.status()["last problem"]
            assert "cuda:0" in problem
            assert "cpu" in problem
        assert detector.node.set_parameters(device="cpu", confidence_threshold=0.25) == ""
        detector.bring_to("active")
        assert set(detector.look().class_names) == set(found)


@pytest.mark.end_to_end
def test_every_mistake_in_a_parameter_file_is_named_and_can_be_corrected(tmp_path: Path) -> None:
    lines = ["confidance_threshold: 0.5", "iou_threshold: 1.5", "max_detections: many", "precision: half"]
    text = "\n".join([*lines, "image_size: 321"])
    with detector_process(*parameter_file(tmp_path, text)) as detector:
        assert not detector.transition("configure")
        told = detector.status()["last problem"]
        for word in (
            "confidance_threshold",
            "Did you mean 'confidence_threshold'?",
            "iou_threshold: 1.5",
            "max_detections: 'many'",
            "precision: 'half'",
            "image_size: 321",
        ):
            assert word in told
            detector.process.wait_for_output(word, PATIENCE_S)
        fixed = {"iou_threshold": 0.5, "max_detections": 10, "precision": "auto"}
        assert detector.node.set_parameters(confidence_threshold=0.5, **fixed, **PARAMETERS) == ""
        detector.bring_to("active")
        assert len(detector.look().scores) > 0


@pytest.mark.long
@pytest.mark.parametrize(
    "order",
    [
        ("cameras", "front.confidence_threshold", "rear.tracker"),
        pytest.param(("front.confidence_threshold", "rear.tracker", "cameras"), marks=pytest.mark.long),
    ],
    ids=["cameras first", "cameras last"],
)
def test_wrong_cameras_and_their_wrong_overrides_are_corrected_one_by_one(
    tmp_path: Path, order: tuple[str, ...]
) -> None:
    text = "cameras: [front, rear, classes]\nfront.confidence_threshold: 7.0\nrear: {tracker: sort}"
    right = {"cameras": ["front", "rear"], "front.confidence_threshold": 0.5, "rear.tracker": "none"}
    with detector_process(*parameter_file(tmp_path, text)) as detector:
        assert not detector.transition("configure")
        for name in order:
            detector.process.wait_for_output(f"{name}: ", PATIENCE_S)
        for name in order:
            assert detector.node.set_parameters(**{name: right[name]}) == ""
        assert detector.transition("configure")


@pytest.mark.long
def test_parameter_files_that_cannot_be_read_are_reported_at_the_start(tmp_path: Path) -> None:
    absent = str(tmp_path / "absent.yaml")
    aliases = tmp_path / "aliases.yaml"
    lines = [f"l{level}: &l{level} [{f'*l{level - 1}, ' * 10}]" for level in range(1, 12)]
    aliases.write_text(
        "\n".join(["/**:", "  ros__parameters:", "    l0: &l0 [x]", *(f"    {line}" for line in lines)])
    )
    arguments = parameter_file(tmp_path, "autostart: true\nclasses: [circle, 0.5]")
    arguments += ["--params-file", absent, "--params-file", str(aliases)]
    with detector_process(*arguments) as detector:
        reasons = [
            "line 4: a list must hold values of one type, this one has 'circle' and 0.5: "
            'write ["circle", "0.5"]',
            f"{absent}: No such file or directory",
            "aliases.yaml: line 4: an alias (*l0)",
        ]
        for _ in range(2):
            told = detector.status()
            assert told["level"] == "ERROR"
            for reason in reasons:
                assert reason in told["message"]
                detector.process.wait_for_output(reason, PATIENCE_S)
            assert not detector.transition("configure")
        assert "Failed to parse global arguments" not in detector.process.output
        assert detector.node.state() == "unconfigured"
        assert detector.process.stop(signal.SIGTERM) == 0
