"""Chromium without a window, driven by Selenium, and a finger of its user."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.remote.webelement import WebElement

from support.colcon_workspace import REPOSITORY

AXE = "AXE_CORE"
"""Environment variable with the path of axe.min.js, from the npm package axe-core."""
DESKTOP, PHONE = (1400, 1000), (360, 740)
"""Width and height in pixels."""
Point = tuple[float, float]
_STEPS = 12
_ARGUMENTS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--disable-dev-shm-usage",  # containers have little of it
)


@contextmanager
def chromium(profile: Path) -> Iterator[Chrome]:
    """A browser whose profile is the empty folder `profile`; skips the test where there is none."""
    program, driver_program = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver_program is None:
        pytest.skip("no Chromium here: apt-get install chromium chromium-driver")
    options = ChromeOptions()
    options.binary_location = program
    width, height = DESKTOP
    for argument in (*_ARGUMENTS, f"--user-data-dir={profile}", f"--window-size={width},{height}"):
        options.add_argument(argument)
    # The path is given, so Selenium looks for no driver, and downloads none.
    driver = Chrome(options=options, service=Service(driver_program))
    try:
        yield driver
    finally:
        driver.quit()


def set_screen(driver: Chrome, size_wh: tuple[int, int], *, is_phone: bool) -> None:
    """Show pages as a screen of this size in CSS pixels does; that of a phone knows touch."""
    width, height = size_wh
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": is_phone}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": is_phone, "maxTouchPoints": 5})


def set_colour_scheme(driver: Chrome, scheme: str) -> None:
    """Show pages as for a user who wants `light` or `dark`."""
    feature = {"name": "prefers-color-scheme", "value": scheme}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})


def axe_source() -> str:
    """axe-core's JavaScript; skips the test where it is not installed."""
    installed = REPOSITORY / "node_modules" / "axe-core" / "axe.min.js"
    path = Path(os.environ.get(AXE) or installed)
    if not path.is_file():
        pytest.skip(f"no axe-core in {path}: npm install --no-save --prefix . axe-core, or set {AXE}")
    return path.read_text()


def middle(part: WebElement) -> Point:
    """The middle of a part in the window, in CSS pixels."""
    script = "const b = arguments[0].getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]"
    x, y = part.parent.execute_script(script, part)
    return float(x), float(y)


class Finger:
    """A finger on the screen."""

    def __init__(self, driver: Chrome) -> None:
        self._driver = driver

    def swipe(self, start_xy: Point, way_xy: Point) -> None:
        """Go from `start_xy` by `way_xy` pixels, and lift the finger."""
        self.drag([start_xy, (start_xy[0] + way_xy[0], start_xy[1] + way_xy[1])])
        self.lift()

    def drag(self, corners: Sequence[Point]) -> None:
        """Touch the first corner and go to each further one; the finger stays down."""
        self._send("touchStart", corners[0])
        for (x1, y1), (x2, y2) in pairwise(corners):
            for step in range(1, _STEPS + 1):
                part = step / _STEPS
                self._send("touchMove", (x1 + (x2 - x1) * part, y1 + (y2 - y1) * part))

    def lift(self, *, is_cancelled: bool = False) -> None:
        """`is_cancelled`: the system takes the touch, as for a call that comes in."""
        self._send("touchCancel" if is_cancelled else "touchEnd")

    def tap(self, point_xy: Point) -> None:
        self.drag([point_xy])
        self.lift()

    def _send(self, kind: str, *points_xy: Point) -> None:
        points = [{"x": x, "y": y} for x, y in points_xy]
        self._driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
