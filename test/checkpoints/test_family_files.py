"""Files of every family that YOLOv5's code has trained are read, and predict what its networks predict."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from support.families import (
    EVERY_FAMILY,
    expected_family,
    families,
    family_architecture,
    family_checkpoint,
    family_pixels,
    modules_digest,
    state_dict_digest,
)

from yolov5_lifecycle.checkpoints.archive import read_archive
from yolov5_lifecycle.checkpoints.pickle_interpreter import unpickled
from yolov5_lifecycle.checkpoints.pickled_model import model_root
from yolov5_lifecycle.checkpoints.pickled_objects import Stub, modules_of
from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors, write_safetensors
from yolov5_lifecycle.models.network import fuse


@pytest.mark.long
@pytest.mark.parametrize("name", EVERY_FAMILY)
def test_a_file_predicts_what_the_official_network_predicts_fused_or_not_and_converted(
    name: str, tmp_path: Path
) -> None:
    data = family_checkpoint(name)
    modules = pickled_modules(data)
    assert state_dict_digest(modules) == families()[name]["state_dict_sha256"], "the file is not official"
    assert modules_digest(modules) == families()[name]["modules_sha256"], "the file is not official"
    model = read_checkpoint(data)
    assert model.architecture == family_architecture(name)

    network, pixels, expected = model.network().eval(), family_pixels(name), expected_family(name)
    with torch.inference_mode():
        expected.check(network(pixels)[0].numpy())
        expected.check(fuse(network)(pixels)[0].numpy())

    write_safetensors(model, tmp_path / "converted.safetensors")
    again = read_safetensors((tmp_path / "converted.safetensors").read_bytes())
    assert (again.architecture, again.class_names) == (model.architecture, model.class_names)
    assert again.state_dict.keys() == model.state_dict.keys()
    assert all(torch.equal(again.state_dict[key], tensor) for key, tensor in model.state_dict.items())


def pickled_modules(data: bytes) -> dict[str, Stub]:
    return modules_of(model_root(unpickled(read_archive(data))))
