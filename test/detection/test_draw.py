"""Annotated images show masks, boxes and labels that can be read, and nothing leaves the image."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.draw import (
    MAX_DRAWN,
    REGION_OPACITY,
    annotate,
    class_colour,
    printable,
    text_colour,
)
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.images.image import ChannelOrder, ColourImage
from yolov5_lifecycle.images.region import BoxFilter, Region

NAMES = ("circle", "square", "triangle", "star")
NONE = Detections(np.empty((0, 4), np.float32), np.empty(0, np.float32), np.empty(0, np.int64))


def one(*box_xyxy: float, class_id: int = 0, score: float = 0.5) -> Detections:
    boxes_xyxy = np.array([box_xyxy], np.float32)
    return Detections(boxes_xyxy, np.array([score], np.float32), np.array([class_id]))


def grey_image(level: int, height: int, width: int, channel_order: ChannelOrder = "rgb") -> ColourImage:
    return ColourImage(np.full((height, width, 3), level, np.uint8), channel_order)


def ink_of_class_1(pixels: NDArray[np.uint8]) -> int:
    """Pixels of white letters; the label is blue, the image black."""
    return int((pixels[..., 0] > 100).sum())


@pytest.mark.parametrize(
    "box_filter", [None, BoxFilter(min_box_size=9.0, region_anchor="foot")], ids=["none", "sizes"]
)
def test_an_image_without_detections_and_regions_is_copied(box_filter: BoxFilter | None) -> None:
    image = ColourImage(np.arange(60, dtype=np.uint8).reshape(4, 5, 3), "rgb")
    drawn = annotate(image, NONE, NAMES, box_filter=box_filter)
    np.testing.assert_array_equal(drawn, image.pixels)
    assert not np.shares_memory(drawn, image.pixels)


def test_the_box_is_drawn_where_it_is() -> None:
    colour = class_colour(2, "rgb")
    drawn = annotate(grey_image(0, 240, 320), one(50, 100, 200, 180, class_id=2), NAMES)
    for x, y in [(50, 140), (200, 140), (120, 180), (50, 100), (200, 180)]:
        assert tuple(drawn[y, x]) == colour, (x, y)
    assert not drawn[120:160, 70:190].any()
    assert not drawn[190:].any()


@pytest.mark.parametrize(
    "box_xyxy",
    [
        pytest.param((0, 0, 40, 40), id="upper left"),
        pytest.param((380, 0, 400, 40), id="upper right"),
        pytest.param((0, 280, 20, 300), id="lower left"),
        pytest.param((399, 299, 400, 300), id="lower right"),
        pytest.param((0, 0, 400, 300), id="everything"),
    ],
)
def test_the_whole_label_is_inside_wherever_the_box_is(box_xyxy: tuple[float, ...]) -> None:
    in_the_middle = annotate(grey_image(0, 300, 400), one(150, 150, 200, 200, class_id=1), NAMES)
    drawn = annotate(grey_image(0, 300, 400), one(*box_xyxy, class_id=1), NAMES)
    assert ink_of_class_1(in_the_middle) > 100
    assert ink_of_class_1(drawn) == ink_of_class_1(in_the_middle)


def test_a_label_has_the_same_margin_on_both_sides() -> None:
    drawn = annotate(grey_image(0, 300, 400), one(150, 150, 152, 152, class_id=1), NAMES)[:149]
    (_, label), (_, ink) = np.nonzero(drawn.any(axis=2)), np.nonzero(drawn[..., 0] > 100)
    assert label.max() - ink.max() == pytest.approx(ink.min() - label.min(), abs=1)


def test_the_id_of_a_track_stands_in_the_label() -> None:
    plain, unconfirmed, tracked = (
        ink_of_class_1(
            annotate(
                grey_image(0, 300, 400), replace(one(150, 150, 200, 200, class_id=1), track_ids=ids), NAMES
            )
        )
        for ids in ((), ("",), ("27",))
    )
    assert plain == unconfirmed < tracked


@settings(deadline=None)
@given(
    height=st.integers(1, 200),
    width=st.integers(1, 200),
    corners=st.lists(st.tuples(*[st.floats(0, 1)] * 4), max_size=4),
    name=st.text(max_size=60),
    channel_order=st.sampled_from(["rgb", "bgr"]),
)
def test_any_box_and_name_can_be_drawn_in_any_image(
    height: int, width: int, corners: list[tuple[float, ...]], name: str, channel_order: ChannelOrder
) -> None:
    relative = np.array(corners, np.float32).reshape(-1, 2, 2)
    boxes_xyxy = (np.sort(relative, axis=1) * np.array((width, height), np.float32)).reshape(-1, 4)
    count = len(boxes_xyxy)
    detections = Detections(boxes_xyxy, np.full(count, 0.5, np.float32), np.zeros(count, np.int64))
    drawn = annotate(grey_image(0, height, width, channel_order), detections, [name])
    assert drawn.shape == (height, width, 3)
    assert drawn.any() == bool(count)


LARGE = 400
"""Sides of an image in which boxes and labels leave room."""


def masked(count: int = 2) -> tuple[Detections, NDArray[np.uint16]]:
    """Detections of classes 1 and 2, without boxes to be seen, and their labels."""
    boxes_xyxy = np.array([[390, 390, 399, 399]] * count, np.float32)
    label_image = np.zeros((LARGE, LARGE), np.uint16)
    label_image[100:200, 50:150] = 2
    label_image[150:250, 100:200] = 1
    scores = np.linspace(0.9, 0.4, count, dtype=np.float32)
    return Detections(boxes_xyxy, scores, np.arange(1, count + 1)), label_image


def random_image(height: int, width: int, channel_order: ChannelOrder = "rgb") -> ColourImage:
    pixels = np.random.default_rng(1).integers(0, 256, (height, width, 3), np.uint8)
    return ColourImage(pixels, channel_order)


@pytest.mark.parametrize("channel_order", ["rgb", "bgr"])
def test_masks_are_translucent_in_the_colours_of_their_classes(channel_order: ChannelOrder) -> None:
    detections, label_image = masked()
    image = random_image(LARGE, LARGE, channel_order)
    drawn = annotate(image, detections, NAMES, label_image=label_image)
    plain = annotate(image, detections, NAMES)
    for label, class_id in ((1, 1), (2, 2)):
        inside = label_image == label
        expected = (image.pixels[inside].astype(float) + class_colour(class_id, channel_order)) / 2
        np.testing.assert_allclose(drawn[inside], expected, atol=1)
    np.testing.assert_array_equal(drawn[label_image == 0], plain[label_image == 0])


def test_masks_of_detections_are_drawn_also_where_nobody_has_computed_their_labels() -> None:
    prototypes = np.ones((1, LARGE // 4, LARGE // 4), np.float32)
    masks = Masks(prototypes, np.array([[5.0]], np.float32), (LARGE, LARGE))
    detections = replace(one(100, 100, 300, 300, class_id=2), masks=masks)
    image = random_image(LARGE, LARGE)
    given = annotate(image, detections, NAMES, label_image=detections.label_image())
    np.testing.assert_array_equal(annotate(image, detections, NAMES), given)
    assert (given != annotate(image, replace(detections, masks=None), NAMES)).any()


def test_there_may_be_more_detections_than_a_byte_can_number() -> None:
    detections, _ = masked(1000)
    label_image = np.repeat(np.arange(LARGE, dtype=np.uint16)[:, None], LARGE, axis=1)
    drawn = annotate(grey_image(0, LARGE, LARGE), detections, ["?"] * 1001, label_image=label_image)
    for row in (1, 255, 256, 257, 300):
        np.testing.assert_allclose(drawn[row, 5], np.array(class_colour(row, "rgb")) / 2, atol=1)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a\x7fb", "a?b"),
        ("café crème", "cafe creme"),
        ("Fußgänger", "Fu?ganger"),
        ("line\nbreak\0", "line?break?"),
        ("ﬁsh", "fish"),
    ],
)
def test_letters_that_cannot_be_drawn_are_replaced(name: str, expected: str) -> None:
    assert printable(name) == expected


def test_of_very_many_boxes_the_best_are_drawn() -> None:
    rows = np.arange(MAX_DRAWN + 1, dtype=np.float32)
    boxes_xyxy = np.stack((rows * 2, rows * 0 + 9, rows * 2 + 1, rows * 0 + 10), axis=1)
    scores, class_ids = np.full(len(rows), 0.5, np.float32), np.zeros(len(rows), np.int64)
    drawn = annotate(grey_image(0, 11, 2 * len(rows)), Detections(boxes_xyxy, scores, class_ids), ["?"])
    assert drawn[10].any(axis=-1).reshape(-1, 2).any(axis=1).tolist() == [True] * MAX_DRAWN + [False]


def test_classes_have_colours_of_their_own() -> None:
    colours = np.array([class_colour(class_id, "rgb") for class_id in range(20)])
    distances = [np.abs(a - b).max() for a, b in itertools.combinations(colours, 2)]
    assert min(distances) >= 30
    assert [class_colour(class_id, "bgr")[::-1] for class_id in range(20)] == [
        tuple(row) for row in colours.tolist()
    ]


def luminance(colour: tuple[int, int, int]) -> float:
    """WCAG 2 relative luminance of an sRGB colour."""
    scaled = [channel / 255 for channel in colour]
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in scaled)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@pytest.mark.parametrize("channel_order", ["rgb", "bgr"])
def test_every_label_has_the_contrast_that_reading_needs(channel_order: ChannelOrder) -> None:
    for class_id in range(1000):
        background = class_colour(class_id, channel_order)
        ink = text_colour(background, channel_order)
        lights = [
            luminance(colour if channel_order == "rgb" else colour[::-1]) for colour in (background, ink)
        ]
        assert (max(lights) + 0.05) / (min(lights) + 0.05) >= 4.5, class_id


def test_a_name_takes_no_more_work_than_a_label_shows() -> None:
    word = "\ufdfa"  # 18 letters once it is decomposed
    assert len(printable(200 * word)) == 40 + len("..")


SIDE = 240
MIDDLE = Region.parse("0.25,0.25 0.75,0.25 0.75,0.75 0.25,0.75")
WHOLE = Region.parse("0,0 1,0 1,1 0,1")


def drawn(image: ColourImage, box_filter: BoxFilter) -> NDArray[np.uint8]:
    return annotate(image, NONE, ("cat",), box_filter=box_filter)


@pytest.mark.parametrize("level", [0, 114, 255])
def test_the_outline_of_a_region_is_visible_on_any_ground_and_faint(level: int) -> None:
    pixels = drawn(grey_image(level, SIDE, 2 * SIDE), BoxFilter(regions=(MIDDLE,))).astype(int)
    rows, columns = np.nonzero((pixels != level).any(axis=2))
    assert (rows.min(), columns.min()) == pytest.approx((SIDE / 4, SIDE / 2), abs=3)
    assert (rows.max(), columns.max()) == pytest.approx((SIDE * 3 / 4, SIDE * 3 / 2), abs=3)
    assert 40 < np.abs(pixels - level).max() <= 128
    inside = pixels[SIDE // 3 : 2 * SIDE // 3, 2 * SIDE // 3 : 4 * SIDE // 3]
    assert (inside == level).all()


def test_the_outline_of_the_whole_image_is_on_its_edges() -> None:
    pixels = drawn(grey_image(0, SIDE, SIDE), BoxFilter(regions=(WHOLE,)))
    assert all(np.median(edge) > 100 for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]))


def test_ignored_regions_are_dark_also_where_they_overlap() -> None:
    other = Region.parse("0.4,0.4 0.9,0.4 0.9,0.6 0.4,0.6")
    pixels = drawn(grey_image(200, SIDE, SIDE), BoxFilter(ignore_regions=(MIDDLE, other))).astype(int)
    darkened = 200 * (1 - REGION_OPACITY)
    assert np.median(pixels[SIDE // 3 : 2 * SIDE // 3, SIDE // 3 : 2 * SIDE // 3]) == darkened
    assert (pixels[SIDE // 2, [SIDE // 2, SIDE * 7 // 8]] == darkened).all()
    assert (pixels[: SIDE // 5] == 200).all()


@pytest.mark.parametrize("size_hw", [(1, 1), (2, 300), (300, 2), (1080, 1920)], ids=str)
def test_a_region_of_the_whole_image_fits_any_image(size_hw: tuple[int, int]) -> None:
    image = grey_image(114, *size_hw)
    both = BoxFilter(regions=(WHOLE,), ignore_regions=(MIDDLE,))
    pixels = drawn(image, both)
    assert pixels.shape == (*size_hw, 3)
    assert (pixels != image.pixels).any()
    np.testing.assert_array_equal(image.pixels, 114)
