"""Fingers on a touch screen, and the wheel of a mouse, as the browser gets them from the device."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from selenium.webdriver import Chrome
from selenium.webdriver.remote.webelement import WebElement

Point = tuple[float, float]
_STEPS = 12


def set_touch_screen(driver: Chrome, *, is_on: bool) -> None:
    """Let pages see a device with a touch screen."""
    driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": is_on, "maxTouchPoints": 5})


def middle(part: WebElement) -> Point:
    """The middle of a part in the window, in CSS pixels."""
    script = "const b = arguments[0].getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]"
    x, y = part.parent.execute_script(script, part)
    return float(x), float(y)


class Finger:
    """One or more fingers of one hand."""

    def __init__(self, driver: Chrome) -> None:
        self._driver = driver

    def swipe(self, start_xy: Point, way_xy: Point) -> None:
        """Go from `start_xy` by `way_xy` pixels, and lift the finger."""
        self.drag([start_xy, (start_xy[0] + way_xy[0], start_xy[1] + way_xy[1])])
        self.lift()

    def drag(self, corners: Sequence[Point]) -> None:
        """Touch the first corner and go to each further one; the finger stays down."""
        self.touch(corners[0])
        for (x1, y1), (x2, y2) in pairwise(corners):
            for step in range(1, _STEPS + 1):
                part = step / _STEPS
                self._send("touchMove", (x1 + (x2 - x1) * part, y1 + (y2 - y1) * part))

    def touch(self, *points_xy: Point) -> None:
        """Put fingers down; those that are down already are named first."""
        self._send("touchStart", *points_xy)

    def move(self, *points_xy: Point) -> None:
        self._send("touchMove", *points_xy)

    def lift(self) -> None:
        self._send("touchEnd")

    def cancel(self) -> None:
        """The system takes the touch, as for a call that comes in."""
        self._send("touchCancel")

    def tap(self, point_xy: Point) -> None:
        self.touch(point_xy)
        self.lift()

    def _send(self, kind: str, *points_xy: Point) -> None:
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points_xy)]
        self._driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def turn_wheel(driver: Chrome, point_xy: Point, down_px: float) -> None:
    """Turn the wheel of a mouse that is over `point_xy`."""
    x, y = point_xy
    wheel = {"type": "mouseWheel", "x": x, "y": y, "deltaX": 0, "deltaY": down_px}
    driver.execute_cdp_cmd("Input.dispatchMouseEvent", wheel)
