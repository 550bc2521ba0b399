"""Drawing of regions, masks, boxes and labels on an image."""

from __future__ import annotations

import colorsys
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ChannelOrder, ColourImage
from yolov5_lifecycle.images.region import BoxFilter, Region

Colour = tuple[int, int, int]

MASK_OPACITY = 0.5
"""Share of the class colour in the pixels of an object, from 0 to 1."""

REGION_OPACITY = 0.5
"""The same of the lines around a region, and of the black on an ignored one."""

_SUBPIXEL_BITS = 4
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MAX_NAME_CHARACTERS = 40
MAX_DRAWN = 1000
"""Boxes drawn on an image, the best ones: of more, none could be made out."""
_GOLDEN_RATIO = 0.618034  # its multiples spread evenly over the hue circle for any number of classes


def annotate(
    image: ColourImage,
    detections: Detections,
    class_names: Sequence[str],
    *,
    distances_m: Sequence[float | None] = (),
    label_image: NDArray[np.uint16] | None = None,
    box_filter: BoxFilter | None = None,
) -> NDArray[np.uint8]:
    """A copy (H, W, 3) of the image, same channel order, with boxes and labels such as "dog #3 0.87 2.4 m".

    The number is that of the track, if there is one. `distances_m` has one entry for each detection, None
    where it is unknown, or is empty. If the detections have masks, these are drawn translucent below the
    boxes; `label_image` is their `Detections.label_image()` where that has been computed already. The regions
    of `box_filter` are drawn faintly below them.

    Line width and font size scale with the image; a label wider than the image is cut off. Non-ASCII
    characters lose their accents or become question marks. Higher scores are drawn over lower ones; only the
    MAX_DRAWN highest have boxes and labels.
    """
    canvas = np.array(image.pixels, order="C")
    pen = _Pen.for_image(image.size_hw)
    if box_filter is not None:
        draw_regions(canvas, box_filter, line_px=pen.line_px)
    labels = detections.label_image() if label_image is None else label_image
    if labels is not None:
        draw_masks(
            canvas,
            labels,
            [class_colour(each, image.channel_order) for each in detections.class_ids.tolist()],
        )
    height, width = image.size_hw
    corners = np.clip(np.rint(detections.boxes_xyxy), 0, np.array((width, height, width, height)) - 1)
    class_ids, details = detections.class_ids.tolist(), _details(detections, distances_m)
    rows = list(zip(corners.astype(int).tolist(), class_ids, details, strict=True))[:MAX_DRAWN][::-1]
    shown = {class_id: printable(class_names[class_id]) for _, class_id, _ in rows}
    for (x1, y1, x2, y2), class_id, _ in rows:
        cv2.rectangle(canvas, (x1, y1), (x2, y2), class_colour(class_id, image.channel_order), pen.line_px)
    for (x1, y1, _, _), class_id, detail in rows:
        colour = class_colour(class_id, image.channel_order)
        label = f"{shown[class_id]} {detail}"
        _draw_label(canvas, label, (x1, y1), pen, colour, text_colour(colour, image.channel_order))
    return canvas


def draw_regions(canvas: NDArray[np.uint8], box_filter: BoxFilter, *, line_px: int) -> None:
    """Outline the regions on `canvas` (H, W, 3); darken those that are ignored.

    A line is white with black on both sides, so that it is visible on any image.
    """
    if not (box_filter.regions or box_filter.ignore_regions):
        return
    size_hw = (canvas.shape[0], canvas.shape[1])
    ignored = _corners(box_filter.ignore_regions, size_hw)
    outlines = [*_corners(box_filter.regions, size_hw), *ignored]
    covered, black, white = canvas.copy(), (0, 0, 0), (255, 255, 255)
    for corners in ignored:  # one by one: a single call leaves out where two overlap
        cv2.fillPoly(covered, [corners], black, shift=_SUBPIXEL_BITS)
    for colour, thickness in ((black, 3 * line_px), (white, line_px)):
        cv2.polylines(covered, outlines, True, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    cv2.addWeighted(covered, REGION_OPACITY, canvas, 1 - REGION_OPACITY, 0, dst=canvas)


def _corners(regions: Sequence[Region], size_hw: tuple[int, int]) -> list[NDArray[np.int32]]:
    """The corners of each region, (n, 1, 2), in fractions of pixels as OpenCV takes them."""
    scale = (np.array(size_hw[::-1]) - 1) * 2**_SUBPIXEL_BITS
    return [np.rint(np.array(region.points_xy) * scale).astype(np.int32)[:, None] for region in regions]


def draw_masks(canvas: NDArray[np.uint8], labels: NDArray[np.uint16], colours: Sequence[Colour]) -> None:
    """Blend each pixel that `labels` (H, W) gives to the i-th detection with the i-th of `colours`."""
    left, top, width, height = cv2.boundingRect((labels > 0).view(np.uint8))
    if not width:
        return
    part = (slice(top, top + height), slice(left, left + width))
    tints = np.array([(0, 0, 0), *colours], np.uint8).take(labels[part], axis=0)
    blended = cv2.addWeighted(canvas[part], 1 - MASK_OPACITY, tints, MASK_OPACITY, 0)
    cv2.copyTo(blended, (labels[part] > 0).view(np.uint8), canvas[part])


def _details(detections: Detections, distances_m: Sequence[float | None]) -> list[str]:
    """What follows the class name in each label."""
    count = len(detections)
    rows = zip(
        detections.track_ids or ("",) * count,
        detections.scores.tolist(),
        distances_m or (None,) * count,
        strict=True,
    )
    return [
        (f"#{track_id} " if track_id else "")
        + f"{score:.2f}"
        + ("" if distance_m is None else f" {distance_m:.1f} m")
        for track_id, score, distance_m in rows
    ]


def class_colour(class_id: int, channel_order: ChannelOrder) -> Colour:
    """A vivid colour, fixed per class and distinct from those of adjacent class ids."""
    hue = class_id * _GOLDEN_RATIO % 1
    saturation, value = (0.9, 0.6)[class_id // 5 % 2], (1.0, 0.75)[class_id // 10 % 2]
    red, green, blue = (round(255 * channel) for channel in colorsys.hsv_to_rgb(hue, saturation, value))
    return (red, green, blue) if channel_order == "rgb" else (blue, green, red)


def text_colour(background: Colour, channel_order: ChannelOrder) -> Colour:
    """Black or white, whichever contrasts more (WCAG 2: equal contrast at relative luminance 0.179)."""
    linear = [((channel / 255 + 0.055) / 1.055) ** 2.4 for channel in background]
    red, green, blue = linear if channel_order == "rgb" else reversed(linear)
    return (0, 0, 0) if 0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.179 else (255, 255, 255)


def printable(text: str) -> str:
    """The beginning of `text`, as much as a label may show, in printable ASCII, as in the Hershey fonts."""
    letters = unicodedata.normalize("NFKD", text[: _MAX_NAME_CHARACTERS + 1])  # of one may become 18
    plain = "".join(letter for letter in letters if not unicodedata.combining(letter))
    cut = plain[:_MAX_NAME_CHARACTERS]
    return "".join(letter if " " <= letter <= "~" else "?" for letter in cut) + ".." * (plain != cut)


@dataclass(frozen=True)
class _Pen:
    """Line width, margin and font size for an image."""

    line_px: int
    margin_px: int
    font_scale: float
    text_thickness: int

    @classmethod
    def for_image(cls, size_hw: tuple[int, int]) -> _Pen:
        side = min(size_hw)
        line_px = max(round(side / 240), 1)
        return cls(line_px, line_px + 1, max(side / 900, 0.4), max(round(side / 480), 1))

    def text_size(self, text: str) -> tuple[int, int, int]:
        """Width of `text`, height above and height below its baseline in pixels."""
        (width, above), below = cv2.getTextSize(text, _FONT, self.font_scale, self.text_thickness)
        return width, above, below


def _draw_label(
    canvas: NDArray[np.uint8], text: str, corner_xy: tuple[int, int], pen: _Pen, colour: Colour, ink: Colour
) -> None:
    """Draw `text` above a box's upper left corner, or below it where there is no room above."""
    height, width, _ = canvas.shape
    text_width, above, below = pen.text_size(text)
    label_width, label_height = text_width + 2 * pen.margin_px, above + below + 2 * pen.margin_px
    if label_height > height:
        return
    left, bottom = max(min(corner_xy[0], width - label_width), 0), corner_xy[1]
    if bottom < label_height:
        bottom = min(bottom + label_height, height)
    top = bottom - label_height
    cv2.rectangle(canvas, (left, top), (left + label_width - 1, bottom - 1), colour, cv2.FILLED)
    origin = (left + pen.margin_px, top + pen.margin_px + above)
    cv2.putText(canvas, text, origin, _FONT, pen.font_scale, ink, pen.text_thickness, cv2.LINE_AA)
