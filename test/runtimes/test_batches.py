"""Frames that are run as one batch: the predictions of each are those of a run with it alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.random_model import random_frame, random_model
from support.runtime_names import COMPILED_RUNTIMES, EVERY_RUNTIME

from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime

SIZE_HW = (64, 96)


def different_frames(count: int) -> list[NDArray[np.uint8]]:
    return list(np.random.default_rng(3).integers(0, 256, (count, *SIZE_HW, 3), np.uint8))


def loaded(runtime_name: str, seed: int = 1) -> Runtime:
    return load_runtime(random_model(seed), runtime_name, device="cpu", precision="fp32")


@pytest.fixture(params=EVERY_RUNTIME, scope="module")
def runtime(request: pytest.FixtureRequest) -> Runtime:
    return loaded(str(request.param))


def rows_of(
    runtime: Runtime, frames: list[NDArray[np.uint8]], orders: list[Order], least: list[float]
) -> list[NDArray[np.float32]]:
    return [predictions.rows for predictions in runtime.run_batch(frames, orders, least)]


@pytest.mark.long
@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_every_frame_has_the_predictions_of_a_run_with_it_alone(count: int, runtime: Runtime) -> None:
    frames = different_frames(count)
    orders: list[Order] = ["rgb", "bgr", "bgr", "rgb"]
    median = float(np.median(runtime(frames[0], "rgb").rows[:, 4]))
    least = [0.0, median, 1.0, 0.0]
    rows = rows_of(runtime, frames, orders[:count], least[:count])
    assert len(rows) == count
    for raw, frame, order, each in zip(rows, frames, orders, least, strict=False):
        expected = runtime(frame, order, each).rows
        assert raw.dtype == np.float32
        assert raw.shape == expected.shape
        np.testing.assert_allclose(raw, expected, rtol=1e-4, atol=1e-4)
    assert len({raw.shape for raw in rows}) == min(count, 3), "each has its own least objectness"


def test_frames_and_earlier_predictions_stay_as_they_are(runtime: Runtime) -> None:
    frames = different_frames(2)
    first = rows_of(runtime, frames, ["bgr", "rgb"], [0.0, 0.0])
    before = [raw.copy() for raw in first]
    runtime.run_batch([255 - frame for frame in frames], ["bgr", "rgb"], [0.0, 0.0])
    np.testing.assert_array_equal(first, before)
    np.testing.assert_array_equal(frames, different_frames(2))


def test_a_frame_that_gives_no_numbers_leaves_the_others_theirs() -> None:
    """Infinity in the frame, as no weights give it for one image of uint8 only."""
    runtime = loaded("torch")
    good = different_frames(1)[0].astype(np.float32)
    rows = rows_of(runtime, [np.full_like(good, np.inf), good], ["rgb"] * 2, [0.0] * 2)  # type: ignore[list-item]
    assert not np.isfinite(rows[0]).all()
    np.testing.assert_allclose(rows[1], runtime(different_frames(1)[0], "rgb").rows, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("frames", "orders", "least"),
    [
        pytest.param([], [], [], id="no frame"),
        pytest.param([random_frame(64, 96), random_frame(96, 64)], ["rgb"] * 2, [0.0] * 2, id="two shapes"),
        pytest.param([random_frame()] * 2, ["rgb"], [0.0] * 2, id="an order is missing"),
        pytest.param([random_frame()] * 2, ["rgb"] * 2, [0.0], id="an objectness is missing"),
    ],
)
def test_what_is_no_batch_is_refused(
    frames: list[NDArray[np.uint8]], orders: list[Order], least: list[float], runtime: Runtime
) -> None:
    with pytest.raises(ValueError, match="A batch needs frames of one shape"):
        runtime.run_batch(frames, orders, least)


@pytest.mark.parametrize("runtime_name", COMPILED_RUNTIMES)
def test_frames_of_another_shape_than_the_stride_allows_are_an_inference_error(runtime_name: str) -> None:
    with pytest.raises(InferenceError, match=f"{runtime_name} failed on cpu: "):
        loaded(runtime_name).run_batch([random_frame(72, 96)] * 2, ["rgb"] * 2, [0.0] * 2)


@pytest.mark.long
@pytest.mark.parametrize("runtime_name", COMPILED_RUNTIMES)
def test_a_batch_is_compiled_once_and_kept_on_disk_by_itself(
    runtime_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache = tmp_path / "yolov5_lifecycle" / "compiled"
    batch = different_frames(3)
    expected = rows_of(loaded(runtime_name), batch, ["rgb"] * 3, [0.0] * 3)
    (file,) = cache.iterdir()
    again = loaded(runtime_name)
    np.testing.assert_array_equal(rows_of(again, batch, ["rgb"] * 3, [0.0] * 3), expected)
    assert list(cache.iterdir()) == [file]
    again(batch[0], "rgb")
    again.run_batch(batch[:2], ["rgb"] * 2, [0.0] * 2)
    assert len(list(cache.iterdir())) == 3


def test_a_batch_that_was_not_kept_is_made_again(runtime: Runtime) -> None:
    frames = different_frames(2)
    first = rows_of(runtime, frames, ["rgb"] * 2, [0.0] * 2)
    runtime.keep_batches([])
    np.testing.assert_array_equal(rows_of(runtime, frames, ["rgb"] * 2, [0.0] * 2), first)
