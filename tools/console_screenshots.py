"""Photographs the console's page on a desktop and on a phone, with the demonstration's camera and model.

PYTHONPATH=test python -m tools.console_screenshots [--seconds 120] [--folder docs/images]
"""

from __future__ import annotations

import argparse
import base64
import io
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image
from selenium.webdriver import Chrome
from support.browser import PHONE, chromium, set_colour_scheme, set_screen
from support.camera_process import camera_process
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.detector_process import NODE, detector_process

from yolov5_lifecycle.ros.demo.demonstrations import SEED

REPOSITORY = Path(__file__).parents[1]
_CAMERA = ("--ros-args", "-p", f"seed:={SEED}", "-p", "rate:=15.0", "-r", f"image_raw:={NODE}/image_raw")
_DESKTOP = (1280, 980)


def main(argv: Sequence[str] | None = None) -> int:
    """Write console.png and console-phone.png; returns 0."""
    given = parser().parse_args(argv)
    with (
        detector_process("--params-file", str(REPOSITORY / "config" / "demo.yaml")) as detector,
        camera_process(detector.domain, *_CAMERA),
        console_process(detector.domain) as console,
        tempfile.TemporaryDirectory() as profile,
        chromium(Path(profile)) as browser,
    ):
        detector.bring_to("active")
        page = ConsolePage(browser, address(console))
        page.open()
        page.wait_for_image()
        page.widget("classes", '[data-name="star"]').click()
        wait_for_history(page, given.seconds)
        page.widget("classes", '[data-name="star"]').click()
        page.wait_for(lambda: not page.is_busy("classes") and not page.chosen("classes"), "all classes")
        page.wait_for_image()
        photograph(browser, given.folder / "console.png", _DESKTOP, is_phone=False)
        set_colour_scheme(browser, "dark")
        page.wait_for_image()
        photograph(browser, given.folder / "console-phone.png", PHONE, is_phone=True)
    return 0


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="console_screenshots", description=__doc__)
    parser.add_argument("--seconds", type=int, default=120, help="seconds of history (default %(default)s)")
    parser.add_argument("--folder", type=Path, default=REPOSITORY / "docs" / "images")
    return parser


def wait_for_history(page: ConsolePage, seconds: int) -> None:
    """Wait until the plots have this many samples, one per second."""
    for _ in range(0, seconds, 10):
        begin = points(page)
        page.wait_for(lambda: points(page) >= begin + 10, "time to pass")  # noqa: B023 - called at once


def points(page: ConsolePage) -> int:
    lines = page.find_all(".plot polyline")
    return sum(len((line.get_attribute("points") or "").split()) for line in lines[:1])


def photograph(browser: Chrome, path: Path, size_wh: tuple[int, int], *, is_phone: bool) -> None:
    """Write the visible part of the page to `path`, in 256 colours: a quarter of the size of all colours."""
    set_screen(browser, size_wh, is_phone=is_phone)
    browser.execute_script(
        "for (const part of [document.documentElement, ...document.querySelectorAll('.parameters')]) "
        "part.scrollTop = 0; document.activeElement.blur()"
    )
    seen = Image.open(io.BytesIO(base64.b64decode(browser.get_screenshot_as_base64())))
    path.parent.mkdir(parents=True, exist_ok=True)
    seen.convert("RGB").quantize(256).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
