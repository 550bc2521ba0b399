"""Networks that segment: every runtime computes the prototypes of masks, of each frame and when asked to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.random_model import CLASS_NAMES, TINY_SEGMENT, random_frame, random_model, random_network
from support.runtime_names import COMPILED_RUNTIMES, EVERY_RUNTIME

from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import InferenceError, Predictions, Runtime

COEFFICIENTS = TINY_SEGMENT.mask_coefficients
FRAMES = [random_frame(), 255 - random_frame(), random_frame()[::-1].copy()]


@pytest.fixture(params=EVERY_RUNTIME)
def runtime(request: pytest.FixtureRequest) -> Runtime:
    return loaded(str(request.param))


def loaded(runtime_name: str) -> Runtime:
    return load_runtime(random_model(1, TINY_SEGMENT), runtime_name, device="cpu", precision="fp32")


def prototypes(predictions: Predictions) -> NDArray[np.float32]:
    assert predictions.compute_prototypes is not None
    return predictions.compute_prototypes()


def expected(frame: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Predictions and prototypes of the network as it was trained."""
    network = random_network(1, TINY_SEGMENT)
    assert isinstance(network.head, Segment)
    pixels = torch.from_numpy(frame.copy()).permute(2, 0, 1)[None] / 255
    with torch.inference_mode():
        features = network.features(pixels)
        return network.predictions(features)[0].numpy(), network.head.proto(features[0])[0].numpy()


@pytest.mark.long
def test_prototypes_and_coefficients_are_those_of_the_network(runtime: Runtime) -> None:
    for frame in FRAMES:
        rows, wanted = expected(frame)
        predictions = runtime(frame, "rgb")
        assert rows.shape[1] == 5 + len(CLASS_NAMES) + COEFFICIENTS
        np.testing.assert_allclose(predictions.rows, rows, rtol=1e-3, atol=1e-3)
        found = prototypes(predictions)
        assert found.dtype == np.float32
        assert found.shape == (COEFFICIENTS, frame.shape[0] // 4, frame.shape[1] // 4)
        np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-3)
        assert wanted.std() > 0.1


def test_prototypes_may_be_computed_twice_and_stay_as_they_are(runtime: Runtime) -> None:
    predictions = runtime(FRAMES[0], "rgb")
    first, second = prototypes(predictions), prototypes(predictions)
    before = first.copy()
    prototypes(runtime(FRAMES[1], "rgb"))
    np.testing.assert_array_equal(first, before)
    np.testing.assert_array_equal(second, before)


def test_after_the_end_there_are_none(runtime: Runtime) -> None:
    predictions = runtime(FRAMES[0], "rgb")
    runtime.close()
    with pytest.raises(InferenceError, match="closed"):
        prototypes(predictions)


@pytest.mark.parametrize("runtime_name", EVERY_RUNTIME)
def test_a_network_that_detects_has_none(runtime_name: str) -> None:
    runtime = load_runtime(random_model(1), runtime_name, device="cpu", precision="fp32")
    assert runtime(FRAMES[0], "rgb").compute_prototypes is None


@pytest.mark.long
@pytest.mark.parametrize("runtime_name", COMPILED_RUNTIMES)
def test_their_part_of_the_network_is_compiled_when_it_is_used_first_and_kept(
    runtime_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache = tmp_path / "yolov5_lifecycle" / "compiled"
    first = loaded(runtime_name)(FRAMES[0], "rgb")
    assert len(list(cache.iterdir())) == 1
    found = prototypes(first)
    files = sorted(cache.iterdir())
    assert len(files) == 2
    np.testing.assert_array_equal(prototypes(loaded(runtime_name)(FRAMES[0], "rgb")), found)
    assert sorted(cache.iterdir()) == files
