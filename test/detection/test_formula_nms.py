"""NMS keeps the boxes that YOLOv5's own implementation keeps."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY
from support.formula_model import formula_model, formula_pixels

from yolov5_lifecycle.detection.nms import MAX_CANDIDATES, Selection, select

EXPECTED = json.loads((REPOSITORY / "test" / "data" / "nms.json").read_text())["models"]
"""By size: the input shape, how the last layer is changed, and cases of settings and detections."""


def selection_of(settings: dict[str, Any]) -> Selection:
    classes = settings["classes"]
    return Selection(**settings | {"classes": None if classes is None else frozenset(classes)})


def places(expected: NDArray[np.float64], found: NDArray[np.float64]) -> NDArray[np.intp]:
    """Where in `found` each expected row is: not their order, as rounding may swap almost equal scores."""
    assert len(found) == len(expected)
    distances = np.abs(expected[:, None, :4] - found[None, :, :4]).max(axis=2)
    distances[expected[:, None, 5] != found[None, :, 5]] = np.inf
    nearest: NDArray[np.intp] = distances.argmin(axis=1)
    assert len(set(nearest)) == len(expected)
    return nearest


@pytest.fixture(scope="module")
def raw(size: str) -> NDArray[np.float32]:
    model = EXPECTED[size]
    network = formula_model(size).network().eval()
    with torch.inference_mode():
        for name, tensor in network.head.m.named_parameters():
            if name.endswith("weight"):
                tensor.mul_(model["detect_gain"])
            else:
                tensor.view(-1, network.head.outputs)[:, 4] += model["objectness_bias"]
        return np.asarray(network(formula_pixels(tuple(model["input_shape"])))[0])


@pytest.mark.parametrize(
    ("size", "case"),
    [
        pytest.param(size, case, id=f"{size}-{number}")
        for size, model in EXPECTED.items()
        for number, case in enumerate(model["cases"])
    ],
    scope="module",
)
def test_the_official_boxes_enter_nms_and_are_kept(case: Any, raw: NDArray[np.float32]) -> None:
    selection = selection_of(case["settings"])
    everything = dataclasses.replace(selection, iou_threshold=1.0, max_detections=MAX_CANDIDATES)
    assert len(select(raw, everything)) == case["candidates"]
    detections = select(raw, selection)
    columns = (detections.boxes_xyxy, detections.scores, detections.class_ids)
    found: NDArray[np.float64] = np.column_stack(columns).astype(np.float64)
    expected = np.array(case["detections"])
    found = found[places(expected, found)]
    np.testing.assert_allclose(found[:, :4], expected[:, :4], rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(found[:, 4:], expected[:, 4:], rtol=0, atol=1e-5)
    assert (np.diff(detections.scores) <= 0).all()
