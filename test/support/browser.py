"""Chromium without a window, driven by Selenium."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service

from support.colcon_workspace import REPOSITORY

AXE = "AXE_CORE"
"""Environment variable with the path of axe.min.js, from the npm package axe-core."""
DESKTOP, PHONE = (1400, 1000), (360, 740)
"""Width and height in pixels."""
_ARGUMENTS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--disable-dev-shm-usage",  # containers have little of it
)


@contextmanager
def chromium(profile: Path, *, size_wh: tuple[int, int] = DESKTOP) -> Iterator[Chrome]:
    """A browser whose profile is the empty folder `profile`; skips the test where there is none."""
    program, driver_program = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver_program is None:
        pytest.skip("no Chromium here: apt-get install chromium chromium-driver")
    options = ChromeOptions()
    options.binary_location = program
    width, height = size_wh
    for argument in (*_ARGUMENTS, f"--user-data-dir={profile}", f"--window-size={width},{height}"):
        options.add_argument(argument)
    # The path is given, so Selenium looks for no driver, and downloads none.
    driver = Chrome(options=options, service=Service(driver_program))
    try:
        yield driver
    finally:
        driver.quit()


def set_screen(driver: Chrome, size_wh: tuple[int, int], *, is_phone: bool, scale: float = 1) -> None:
    """Show pages as a screen of this size in CSS pixels does, `scale` device pixels each."""
    width, height = size_wh
    metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": is_phone}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


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
