"""Detections drawn on their picture."""

from __future__ import annotations

import colorsys
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detections import Detections
from yolov5_lifecycle.images import Order, Picture

Colour = tuple[int, int, int]

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MAX_LABEL_LETTERS = 40
_GOLDEN_RATIO = 0.618034  # its multiples fill the circle of hues evenly, however many there are


def annotate(picture: Picture, detections: Detections, class_names: Sequence[str]) -> NDArray[np.uint8]:
    """A copy (H, W, 3) of the picture, colours in its order, with boxes and labels such as "dog 0.87".

    Lines and letters grow with the picture; a label that does not fit into it is cut. Letters other than
    ASCII lose their accents or become question marks. Better detections cover worse ones.
    """
    canvas = np.array(picture.pixels, order="C")
    pen = _Pen.for_picture(picture.size_hw)
    rows = zip(detections.boxes_xyxy, detections.scores, detections.class_ids.tolist(), strict=True)
    for box_xyxy, score, class_id in reversed(list(rows)):
        colour = class_colour(class_id, picture.order)
        x1, y1, x2, y2 = _corners_inside(box_xyxy, picture.size_hw)
        cv2.rectangle(canvas, (x1, y1), (x2, y2), colour, pen.thickness)
        label = pen.label(f"{printable(class_names[class_id])} {score:.2f}", max_width=canvas.shape[1])
        label.draw(canvas, (x1, y1), colour, text_colour(colour, picture.order))
    return canvas


def class_colour(class_id: int, order: Order) -> Colour:
    """A vivid colour, always the same for a class and unlike those of its neighbours."""
    hue = class_id * _GOLDEN_RATIO % 1
    saturation, value = (0.9, 0.6)[class_id // 5 % 2], (1.0, 0.75)[class_id // 10 % 2]
    red, green, blue = (round(255 * channel) for channel in colorsys.hsv_to_rgb(hue, saturation, value))
    return (red, green, blue) if order == "rgb" else (blue, green, red)


def text_colour(background: Colour, order: Order) -> Colour:
    """Black or white, whichever has more contrast (WCAG 2: relative luminance, equal at 0.179)."""
    linear = [((channel / 255 + 0.055) / 1.055) ** 2.4 for channel in background]
    red, green, blue = linear if order == "rgb" else reversed(linear)
    return (0, 0, 0) if 0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.179 else (255, 255, 255)


def printable(text: str) -> str:
    """`text` in the letters of OpenCV's Hershey fonts, which are printable ASCII."""
    plain = (letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
    return "".join(letter if " " <= letter <= "~" else "?" for letter in plain)


@dataclass(frozen=True)
class _Label:
    """A line of text on a filled rectangle, sizes in pixels."""

    text: str
    pen: _Pen
    width: int
    height: int
    baseline: int

    def draw(
        self, canvas: NDArray[np.uint8], box_top_left: tuple[int, int], colour: Colour, ink: Colour
    ) -> None:
        """Draw above the box, or inside it at the top of the picture; nothing when the picture is too low."""
        height, width, _ = canvas.shape
        if not self.text or self.height > height:
            return
        left = min(box_top_left[0], width - self.width)
        top = box_top_left[1] - self.height
        if top < 0:
            top = min(box_top_left[1], height - self.height)
        cv2.rectangle(canvas, (left, top), (left + self.width - 1, top + self.height - 1), colour, cv2.FILLED)
        origin = (left + self.pen.margin, top + self.height - self.baseline - self.pen.margin)
        cv2.putText(
            canvas, self.text, origin, _FONT, self.pen.font_scale, ink, self.pen.text_thickness, cv2.LINE_AA
        )


@dataclass(frozen=True)
class _Pen:
    """How thick and large to draw."""

    thickness: int
    text_thickness: int
    font_scale: float
    margin: int

    @classmethod
    def for_picture(cls, size_hw: tuple[int, int]) -> _Pen:
        side = min(size_hw)
        thickness = max(round(side / 240), 1)
        return cls(thickness, max(round(side / 480), 1), max(side / 900, 0.4), thickness + 1)

    def label(self, text: str, *, max_width: int) -> _Label:
        """`text`, shortened until it fits; empty when nothing does."""
        shorter = [text[:length] + ".." for length in range(min(len(text), _MAX_LABEL_LETTERS), 0, -1)]
        whole = [text] if len(text) <= _MAX_LABEL_LETTERS else []
        for candidate in [*whole, *shorter]:
            (width, height), baseline = cv2.getTextSize(candidate, _FONT, self.font_scale, self.text_thickness)
            if width + 2 * self.margin <= max_width:
                size = (width + 2 * self.margin, height + baseline + 2 * self.margin)
                return _Label(candidate, self, *size, baseline)
        return _Label("", self, 0, 0, 0)


def _corners_inside(box_xyxy: NDArray[np.float32], size_hw: tuple[int, int]) -> list[int]:
    """The nearest whole pixels; a box that ends at the edge of the picture ends on its last pixel."""
    height, width = size_hw
    last_xyxy = np.array((width, height, width, height)) - 1
    corners: list[int] = np.clip(np.rint(box_xyxy), 0, last_xyxy).astype(int).tolist()
    return corners
