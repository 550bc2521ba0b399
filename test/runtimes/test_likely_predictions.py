"""Every runtime returns the predictions that are likely enough to matter, and few others."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.random_model import CLASS_NAMES, random_model, random_network
from support.runtime_names import EVERY_RUNTIME

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection, select
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime

FRAME = np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)


@pytest.fixture(params=EVERY_RUNTIME, scope="module")
def runtime_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def runtime(runtime_name: str) -> Runtime:
    return loaded(random_model(5), runtime_name)


@pytest.fixture(scope="module")
def every_row() -> NDArray[np.float32]:
    """What the network as it was trained predicts for every anchor of every cell."""
    pixels = torch.from_numpy(FRAME).permute(2, 0, 1)[None] / 255
    with torch.inference_mode():
        rows: NDArray[np.float32] = random_network(5)(pixels)[0].numpy()
    return rows


def loaded(model: Model, runtime_name: str) -> Runtime:
    return load_runtime(model, runtime_name, device="cpu", precision="fp32")


def places(rows: NDArray[np.float32], every_row: NDArray[np.float32]) -> list[int]:
    """Where among all rows those that are given are."""
    distances = np.abs(rows[:, None] - every_row[None]).max(axis=2)
    assert distances.min(axis=1).max() < 1e-3
    return [int(place) for place in distances.argmin(axis=1)]


@pytest.mark.long
@pytest.mark.parametrize("rank", [0, 5, 100, -1], ids=lambda rank: f"rank {rank}")
def test_all_that_are_likely_enough_are_given_in_their_order_and_few_others(
    rank: int, runtime: Runtime, every_row: NDArray[np.float32]
) -> None:
    least = float(np.sort(every_row[:, 4])[::-1][rank])
    given_places = places(runtime(FRAME, "rgb", least - 1e-5).rows, every_row)
    assert given_places == sorted(set(given_places))
    wanted = np.flatnonzero(every_row[:, 4] >= least)
    assert set(wanted) <= set(given_places)
    assert len(given_places) <= 3 * len(wanted), "more than the cells with one of them"


@pytest.mark.parametrize("min_objectness", [0.999, 1.0])
def test_none_is_given_when_none_is_likely_enough(
    min_objectness: float, runtime: Runtime, every_row: NDArray[np.float32]
) -> None:
    assert every_row[:, 4].max() < 0.99
    rows = runtime(FRAME, "rgb", min_objectness).rows
    assert rows.shape == (0, every_row.shape[1])
    assert rows.dtype == np.float32


def test_all_are_given_to_who_asks_for_no_objectness(
    runtime: Runtime, every_row: NDArray[np.float32]
) -> None:
    np.testing.assert_allclose(runtime(FRAME, "rgb").rows, every_row, rtol=1e-3, atol=1e-3)


@pytest.mark.long
@settings(max_examples=30, deadline=None)
@given(
    threshold=st.floats(0, 1),
    agnostic=st.booleans(),
    classes=st.none() | st.frozensets(st.integers(0, len(CLASS_NAMES) - 1), min_size=1),
)
def test_detections_and_the_best_that_was_missed_are_those_of_all_predictions(
    threshold: float, agnostic: bool, classes: frozenset[int] | None, runtime: Runtime
) -> None:
    selection = Selection(confidence_threshold=threshold, agnostic_nms=agnostic, classes=classes)
    found, expected = (
        select(runtime(FRAME, "rgb", least).rows, selection) for least in (selection.min_objectness, 0.0)
    )
    np.testing.assert_array_equal(found.class_ids, expected.class_ids)
    np.testing.assert_allclose(found.scores, expected.scores, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.boxes_xyxy, expected.boxes_xyxy, rtol=0, atol=1e-3)
    assert found.best_missed == pytest.approx(expected.best_missed, abs=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(
    ("key", "place", "value"),
    [
        pytest.param("model.0.conv.weight", 0, np.nan, id="NaN in the first layer"),
        pytest.param("model.0.conv.weight", 0, np.inf, id="infinity in the first layer"),
        pytest.param("model.24.m.0.bias", 4, np.nan, id="NaN as objectness"),
    ],
)
def test_weights_that_give_no_numbers_are_noticed_whatever_the_threshold(
    key: str, place: int, value: float, runtime_name: str
) -> None:
    model = random_model(5)
    model.state_dict[key].view(-1)[place] = value
    detector = Detector(loaded(model, runtime_name), class_names=CLASS_NAMES, image_size=128, stride=32)
    for threshold in (0.0, 1.0):
        with pytest.raises(InferenceError, match="not finite"):
            detector.detect(ColourImage(FRAME, "rgb"), Selection(confidence_threshold=threshold))


def test_products_of_matrices_start_no_threads_that_would_compete_with_the_network() -> None:
    program = (
        "import os\n"
        "from yolov5_lifecycle.process.environment import prepare_environment\n"
        "prepare_environment()\n"
        "import numpy as np\n"
        "np.ones((512, 512), np.float32) @ np.ones((512, 512), np.float32)\n"
        "print(len(os.listdir('/proc/self/task')))"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    threads = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert threads.stdout == "1\n"
