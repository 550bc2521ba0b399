"""Networks of all ten sizes, fused or not, predict what YOLOv5's own implementation predicts."""

from __future__ import annotations

import pytest
import torch
from support.formula_model import EVERY_SIZE, expected_predictions, formula_model, formula_pixels

from yolov5_lifecycle.models.network import fuse


@pytest.mark.parametrize("size", EVERY_SIZE)
def test_a_network_predicts_what_the_official_one_predicts_fused_or_not(size: str) -> None:
    expected = expected_predictions(size)
    pixels = formula_pixels(expected.input_shape)
    network = formula_model(size).network().eval()
    with torch.inference_mode():
        expected.check(network(pixels)[0].numpy())
        expected.check(fuse(network)(pixels)[0].numpy())
