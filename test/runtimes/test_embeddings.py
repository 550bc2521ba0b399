"""Every runtime says what a whole frame looks like, when asked to."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.random_model import random_frame, random_model, random_network
from support.runtime_names import EVERY_RUNTIME

from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import Predictions

FRAMES = [random_frame(), 255 - random_frame(), random_frame()[::-1].copy()]


def embedding(predictions: Predictions) -> NDArray[np.float32]:
    assert predictions.compute_embedding is not None
    return predictions.compute_embedding()


def expected(frame: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The mean of the coarsest features of the network as it was trained."""
    pixels = torch.from_numpy(frame.copy()).permute(2, 0, 1)[None] / 255
    with torch.inference_mode():
        coarsest = random_network(1).features(pixels)[-1]
    return np.asarray(coarsest[0].numpy().mean(axis=(1, 2)))


@pytest.mark.long
@pytest.mark.parametrize("runtime_name", EVERY_RUNTIME)
def test_an_embedding_is_the_mean_of_the_coarsest_features_of_its_frame(runtime_name: str) -> None:
    runtime = load_runtime(random_model(1), runtime_name, device="cpu", precision="fp32")
    alone = [embedding(runtime(frame, "rgb")) for frame in FRAMES]
    for found, frame in zip(alone, FRAMES, strict=True):
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected(frame), rtol=1e-3, atol=1e-4)
    assert np.ptp(alone, axis=0).max() > 0.01  # frames differ
