"""`convert --describe` tells in one screen what a file holds, and why it cannot be used."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from support.checkpoint_builder import layers_of, official_model, saved, stripped
from support.onnx_exports import small_export
from support.small_families import EVERY_SMALL, SMALL_FAMILIES
from torch import nn

from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.commands.convert import main

SCREEN_LINES, SCREEN_COLUMNS = 24, 110


def described(path: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> Mapping[str, str]:
    """Facts by their labels; those of several lines joined."""
    assert main(["--describe", str(path)]) == code
    told = capsys.readouterr()
    assert told.err == ""
    lines = told.out.splitlines()
    assert len(lines) <= SCREEN_LINES
    assert all(line.isprintable() and len(line) <= SCREEN_COLUMNS for line in lines)
    facts: dict[str, str] = {}
    for line in lines:
        label = line[:14].strip() or list(facts)[-1]
        facts[label] = f"{facts.get(label, '')} {line[14:].strip()}".strip()
    return facts


def written(folder: Path, checkpoint: object) -> Path:
    path = folder / "best.pt"
    path.write_bytes(saved(checkpoint))
    return path


def test_layers_images_anchors_and_classes_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, stripped(official_model(EVERY_SMALL["resized"])))
    facts = described(path, capsys)
    assert facts["layers"].startswith("2 Conv, 1 Focus, 1 ZeroPad2d, 1 MaxPool2d")
    assert facts["activations"] == "14 SiLU"
    assert facts["images"] == "grey, height and width multiples of 8"
    assert facts["strides"] == "4, 8"
    assert facts["cost"] == "0.2 GFLOPs, 15 MB at 640x640"
    assert facts["anchors"] == "10x13, 16x30; 30x61, 62x45"
    assert facts["classes"] == "3: cat, dog, cow"
    assert facts["usable"] == "yes"

    write_safetensors(read_checkpoint(path.read_bytes()), tmp_path / "a.safetensors")
    converted = described(tmp_path / "a.safetensors", capsys)
    assert {label: converted[label] for label in ("images", "strides", "anchors", "classes")} == {
        label: facts[label] for label in ("images", "strides", "anchors", "classes")
    }


def test_a_model_that_segments_is_told_with_its_masks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = official_model(SMALL_FAMILIES["segmentation"], kind="models.yolo.SegmentationModel")
    facts = described(written(tmp_path, stripped(model)), capsys)
    assert facts["layers"].endswith("1 Segment")
    assert facts["masks"] == "8 prototypes, computed in 8 channels"


def test_an_export_is_told_with_what_it_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "best.onnx").write_bytes(small_export(has_objectness=False, masks=4))
    facts = described(tmp_path / "best.onnx", capsys)
    assert facts["boxes"] == "without objectness"
    assert facts["images"] == "colour, 96x64, fp32, batches of 1"
    assert facts["masks"] == "4 prototypes"
    assert facts["classes"] == "3: cat, dog, cow"
    assert facts["usable"] == "yes"


def test_of_a_refused_file_size_and_reason_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = official_model()
    vars(layers_of(model)["0"])["_modules"]["act"] = nn.GELU()
    facts = described(written(tmp_path, stripped(model)), capsys, code=1)
    assert facts.keys() == {"file", "size", "usable"}
    assert facts["usable"].startswith("no: the module model.0.act is a 'GELU'")


def test_a_file_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "there is no such file" in described(tmp_path / "none.pt", capsys, code=1)["usable"]
