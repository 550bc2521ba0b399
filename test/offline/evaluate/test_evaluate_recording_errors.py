"""Errors of `evaluate` for recordings whose corrected detections cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.evaluated_offline import evaluate, labelled_drive, report_of
from support.recorded_scene import TOPIC

from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES
from yolov5_lifecycle.offline.evaluate import labelled_data
from yolov5_lifecycle.offline.recording import Recording
from yolov5_lifecycle.sources.scene import CLASS_NAMES


def changed(**values: Any) -> Callable[[Any], Any]:
    """Changes the class or the box of the first detection in a message."""

    def change(message: Any) -> Any:
        first = message.detections[0]
        for name, value in values.items():
            setattr(first.results[0].hypothesis if name == "class_id" else first.bbox, name, value)
        return message

    return change


def no_class(message: Any) -> Any:
    message.detections[0].results.clear()
    return message


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        pytest.param(changed(size_x=float("nan")), "not finite", id="NaN"),
        pytest.param(changed(size_y=-3.0), "a size of", id="negative"),
        pytest.param(no_class, "a detection has no class", id="no class"),
        pytest.param(changed(class_id="unicorn"), "'unicorn' is not in its label_info", id="unknown class"),
        pytest.param(lambda _: b"\0\1\0\0\xff\xff", "found other bytes", id="no message"),
    ],
)
def test_broken_detections_of_a_recording_are_refused(
    change: Callable[[Any], Any], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = labelled_drive(tmp_path / "drive", change=change)
    assert evaluate(drive) == 1
    error = capsys.readouterr().err
    assert reason in error
    assert "none of 3 messages on /yolov5/detections can be used. 3 broken labels\n" in error


@pytest.mark.long
def test_without_label_info_the_classes_are_those_that_occur(tmp_path: Path) -> None:
    drive = labelled_drive(tmp_path / "drive", class_names=None, change=without_stars)
    assert evaluate(drive, "--topic", TOPIC, "--output", str(tmp_path / "out")) == 0
    names = [row["name"] for row in report_of(tmp_path / "out")["classes"]]
    assert sorted(names) == ["circle", "square", "triangle"]


def without_stars(message: Any) -> Any:
    message.detections = [one for one in message.detections if one.results[0].hypothesis.class_id != "star"]
    return message


def stampless(message: Any) -> Any:
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    return message


def test_class_names_that_occur_are_limited_in_length(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = labelled_drive(tmp_path / "drive", class_names=None, change=changed(class_id="x" * 201))
    assert evaluate(drive) == 1
    assert "found a class name of 201 characters, more than 200" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        pytest.param(["x" * 201], "a class name of 201 characters, more than 200", id="length"),
        pytest.param(["x"] * (MAX_CLASSES + 1), "found 10001 classes, more than 10000", id="number"),
    ],
)
def test_class_names_of_label_info_are_limited(
    names: list[str], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluate(labelled_drive(tmp_path / "drive", class_names=names))
    assert reason in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("MAX_IMAGES", "expected at most 2 messages on /yolov5/detections, found 3"),
        ("MAX_OBJECTS", "expected at most 2 objects in a data set, found"),
    ],
)
def test_labels_of_a_recording_are_limited_in_total(
    name: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(labelled_data, name, 2)
    assert evaluate(labelled_drive(tmp_path / "drive")) == 1
    assert told in capsys.readouterr().err


def test_detections_with_the_same_stamp_label_no_image(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(labelled_drive(tmp_path / "drive", change=stampless)) == 1
    error = capsys.readouterr().err
    assert "other detections have the same stamp" in error
    assert "none of 3 messages on /yolov5/detections can be used. 2 broken labels\n" in error


@pytest.mark.long
def test_an_image_that_repeats_a_stamp_is_counted_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = labelled_drive(tmp_path / "drive", numbers=(0, 1, 1, 2))
    assert evaluate(drive, "--output", str(tmp_path / "out")) == 0
    assert "another image has the same stamp" in capsys.readouterr().err
    report = report_of(tmp_path / "out")
    assert report["data"]["images"] == 3
    assert report["data"]["problems"]["counts"] == {"unusable images": 1}


def test_images_that_a_recording_claims_and_lacks_are_counted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = labelled_drive(tmp_path / "drive")
    one_of = Recording.one_of
    monkeypatch.setattr(Recording, "one_of", lambda *words, **more: replace(one_of(*words, **more), count=5))
    assert evaluate(drive, "--compare", "confidence_threshold=0.5") == 0
    output, error = capsys.readouterr()
    assert error.count("missing images: ") == error.count("the recording claims 5 images, but has 3") == 1
    assert "not evaluated: 2 missing images\n" in output


def test_the_classes_are_those_of_the_node_that_published_the_detections(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(labelled_drive(tmp_path / "drive", other_names=["face"])) == 0
    assert "not evaluated" not in capsys.readouterr().out


@pytest.mark.long
def test_the_classes_of_other_nodes_are_not_used(tmp_path: Path) -> None:
    drive = labelled_drive(
        tmp_path / "drive", class_names=["unicorn"], other_names=["face"], topics=("/corrected",)
    )
    assert evaluate(drive, "--output", str(tmp_path / "out")) == 0
    names = [row["name"] for row in report_of(tmp_path / "out")["classes"]]
    assert names
    assert set(names) <= set(CLASS_NAMES)
