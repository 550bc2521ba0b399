"""Every runtime predicts what YOLOv5's own implementation predicts, for all ten sizes."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from support.compiled_networks import engine, predicted
from support.formula_model import EVERY_SIZE, expected_predictions, formula_model, formula_pixels
from support.runtime_names import COMPILED_RUNTIMES

from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime


@pytest.mark.parametrize("size", EVERY_SIZE)
def test_torch_predicts_what_the_official_network_predicts(size: str) -> None:
    expected = expected_predictions(size)
    runtime = TorchRuntime.load(formula_model(size), device="cpu", precision="fp32")
    # The pixels are no multiples of 1/255; torch also takes fractions of a grey level.
    frame = 255 * formula_pixels(expected.input_shape)[0].permute(1, 2, 0).contiguous().numpy()
    expected.check(runtime(cast("NDArray[np.uint8]", frame), "rgb").rows)


@pytest.mark.long
@pytest.mark.parametrize("size", EVERY_SIZE)
@pytest.mark.parametrize("runtime_name", COMPILED_RUNTIMES)
def test_a_compiled_network_predicts_what_the_official_one_predicts(runtime_name: str, size: str) -> None:
    expected = expected_predictions(size)
    pixels = formula_pixels(expected.input_shape).numpy()
    expected.check(predicted(formula_model(size), engine(runtime_name), pixels))
