"""Masks of detections are those of YOLOv5's own implementation, and one label image has them all."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike, NDArray
from support.colcon_workspace import REPOSITORY
from support.formula_model import expected_predictions, formula_model, formula_pixels
from support.reference_masks import reference_mask, whole_mask

from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.models.head import Segment

EXPECTED = json.loads((REPOSITORY / "test" / "data" / "masks.json").read_text())
MAX_DIFFERENT = 0.001
"""Share of an object's pixels."""


def floats(values: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(values, np.float32)


@pytest.fixture(scope="module", params=EXPECTED)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def prototypes(name: str) -> NDArray[np.float32]:
    network = formula_model(name).network().eval()
    assert isinstance(network.head, Segment)
    with torch.inference_mode():
        features = network.features(formula_pixels(expected_predictions(name).input_shape))
        computed: NDArray[np.float32] = network.head.proto(features[0])[0].numpy()
    return computed


def test_prototypes_are_those_of_the_official_network(name: str, prototypes: NDArray[np.float32]) -> None:
    expected = EXPECTED[name]["prototypes"]
    assert [1, *prototypes.shape] == expected["shape"]
    sums = prototypes.sum(axis=(1, 2), dtype=np.float64)
    np.testing.assert_allclose(sums, expected["sums_per_channel"], rtol=1e-3, atol=1e-3)
    values = prototypes.ravel()[expected["flat_indices"]]
    np.testing.assert_allclose(values, expected["values"], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("case", [0, 1], ids=["no padding", "an image with padding"])
def test_masks_are_those_of_the_official_implementation(
    name: str, prototypes: NDArray[np.float32], case: int
) -> None:
    found = EXPECTED[name]
    wanted = found["cases"][case]
    bits = np.frombuffer(base64.b64decode(wanted["bits_base64"]), np.uint8)
    count, height, width = wanted["shape"]
    expected = np.unpackbits(bits)[: count * height * width].reshape(count, height, width).astype(bool)
    masks = Masks.in_image(prototypes, floats(found["coefficients"]), (height, width))
    for row, box_xyxy in enumerate(floats(wanted["boxes_xyxy"])):
        mask = whole_mask(masks, row, box_xyxy)
        assert expected[row].any()
        assert (mask != expected[row]).sum() <= MAX_DIFFERENT * expected[row].sum()


def random_masks(
    seed: int, size_hw: tuple[int, int], cells_hw: tuple[int, int], count: int = 5
) -> tuple[Masks, NDArray[np.float32]]:
    """Masks, and boxes that may reach beyond the image, as no detection does."""
    rng = np.random.default_rng(seed)
    prototypes, coefficients = floats(rng.normal(size=(4, *cells_hw))), floats(rng.normal(size=(count, 4)))
    masks = Masks(prototypes, coefficients, size_hw)
    corners = np.sort(rng.uniform(-0.1, 1.1, (count, 2, 2)), axis=1) * size_hw[::-1]
    return masks, floats(corners.reshape(count, 4))


@pytest.mark.parametrize(
    ("size_hw", "cells_hw"),
    [
        pytest.param((480, 640), (120, 160), id="four pixels a cell"),
        pytest.param((72, 100), (46, 64), id="fractions of a cell"),
        pytest.param((20, 30), (48, 72), id="fewer pixels than cells"),
        pytest.param((1, 50), (1, 40), id="one row"),
    ],
)
def test_a_part_of_a_mask_is_that_of_the_whole(size_hw: tuple[int, int], cells_hw: tuple[int, int]) -> None:
    masks, boxes_xyxy = random_masks(3, size_hw, cells_hw, count=40)
    for row, box_xyxy in enumerate(boxes_xyxy):
        expected = reference_mask(masks, row, box_xyxy)
        unsure = np.abs(expected - 0.5) < 1e-5
        differs = whole_mask(masks, row, box_xyxy) != (expected > 0.5)
        assert not (differs & ~unsure).any()


def test_a_mask_at_any_pixels_is_that_of_the_whole_and_goes_on_beside_the_box_and_the_image() -> None:
    masks, _ = random_masks(6, (72, 100), (46, 64))
    everywhere = floats((0, 0, 100, 72))
    rows, columns = np.array([71, 3, 3, 40]), np.array([99, 0, 57])
    beyond = masks.at(2, np.where(rows == 71, 160, rows), np.where(columns == 0, -9, columns))
    np.testing.assert_array_equal(beyond, masks.at(2, rows, columns))
    np.testing.assert_array_equal(beyond, whole_mask(masks, 2, everywhere)[np.ix_(rows, columns)])
    assert 0 < beyond.mean() < 1


def test_labels_number_the_detections_and_the_better_one_covers_the_others() -> None:
    masks, boxes_xyxy = random_masks(4, (60, 80), (30, 40))
    labels = masks.label_image(boxes_xyxy)
    assert labels.shape == (60, 80)
    assert labels.dtype == np.uint16
    each = np.stack([whole_mask(masks, row, box_xyxy) for row, box_xyxy in enumerate(boxes_xyxy)])
    assert each.sum(axis=0).max() > 1
    expected = np.where(each.any(axis=0), each.argmax(axis=0) + 1, 0)
    np.testing.assert_array_equal(labels, expected)


@pytest.mark.parametrize(
    "box_xyxy",
    [(5, 5, 5, 9), (5.2, 5.2, 5.8, 5.8), (30, 20, 30, 20), (0, 0, 0, 0)],
    ids=["no width", "between pixels", "at the last corner", "at the first corner"],
)
def test_a_box_without_pixels_has_an_empty_mask(box_xyxy: tuple[float, ...]) -> None:
    masks, _ = random_masks(5, (20, 30), (10, 15), count=1)
    assert not whole_mask(masks, 0, floats(box_xyxy)).any()


@pytest.mark.parametrize("size_hw", [(1, 4000), (4000, 1), (3, 5), (1, 1)], ids=str)
def test_an_image_of_any_shape_keeps_some_cells_of_its_network_input(size_hw: tuple[int, int]) -> None:
    cells_hw = (8, 160) if size_hw[0] < size_hw[1] else (160, 8)
    masks = Masks.in_image(np.ones((2, *cells_hw), np.float32), np.ones((1, 2), np.float32), size_hw)
    assert min(masks.prototypes.shape[1:]) >= 1
    labels = masks.label_image(floats([[0, 0, size_hw[1], size_hw[0]]]))
    np.testing.assert_array_equal(labels, np.ones(size_hw))


def test_boxes_beyond_the_budget_of_pixels_have_no_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    everywhere = Masks(np.ones((1, 4, 4), np.float32), np.ones((3, 1), np.float32), (8, 8))
    boxes_xyxy = floats([[-9, -9, 4, 8], [4, 0, 8, 4], [4, 4, 99, 99]])  # 32, 16 and 16 pixels in the image
    monkeypatch.setattr("yolov5_lifecycle.detection.masks.MAX_MASK_PIXELS", 48)
    assert np.unique(everywhere.label_image(boxes_xyxy)).tolist() == [0, 1, 2]
    monkeypatch.setattr("yolov5_lifecycle.detection.masks.MAX_MASK_PIXELS", 64)
    assert np.unique(everywhere.label_image(boxes_xyxy)).tolist() == [1, 2, 3]


@pytest.mark.parametrize("number", [1e30, np.inf, np.nan])
def test_coefficients_of_any_size_raise_nothing(number: float) -> None:
    masks = Masks(np.ones((2, 4, 4), np.float32), floats([[number, -number]]), (8, 8))
    assert masks.label_image(floats([[0, 0, 8, 8]])).max() <= 1
