"""The button with which a person keeps an image, in a browser, with the installed processes."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium.webdriver import ActionChains, Chrome
from selenium.webdriver.common.keys import Keys
from support.browser import DESKTOP, PHONE, set_screen
from support.camera_process import camera_process
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.console_robot import CAMERA, ConsoleRobot
from support.detector_process import PARAMETERS, as_arguments, detector_process
from support.finger import Finger, middle, set_touch_screen

from yolov5_lifecycle.collecting.collected_files import read_frame_list

pytestmark = pytest.mark.long

BUTTON = ".collect button"


@pytest.fixture
def phone(browser: Chrome) -> Iterator[Chrome]:
    """The browser with the screen of a phone."""
    set_screen(browser, PHONE, is_phone=True)
    set_touch_screen(browser, is_on=True)
    yield browser
    set_touch_screen(browser, is_on=False)
    set_screen(browser, DESKTOP, is_phone=False)


def test_an_image_that_is_asked_for_is_kept_and_the_page_says_so(phone: Chrome, tmp_path: Path) -> None:
    parameters = PARAMETERS | {"collect_dir": tmp_path, "collect": True, "collect_min_free_mb": 0}
    with (
        detector_process(*as_arguments(parameters)) as detector,
        camera_process(detector.domain, *CAMERA),
        console_process(detector.domain) as console,
    ):
        detector.bring_to("active")
        page = ConsolePage(phone, address(console))
        page.open()
        page.wait_for_image()
        button = page.find(BUTTON)
        phone.execute_script("arguments[0].scrollIntoView({ block: 'center' })", button)
        Finger(phone).tap(middle(button))
        page.wait_for_text(".collect .result", "the next image is kept")
        page.wait_for(
            lambda: any("requested" in frame.reasons for frame in read_frame_list(tmp_path).frames),
            "the image",
        )
        assert page.text(".collect .refusal") == ""
        detector.process.stop(signal.SIGKILL)
        page.wait_for(lambda: not page.find(".collect").is_displayed(), "no button for a lost detector")


def test_the_keyboard_asks_for_an_image_and_a_refusal_has_the_words_of_the_node(
    robot: ConsoleRobot, page: ConsolePage
) -> None:
    assert page.text(BUTTON) == "Keep this image"
    page.driver.execute_script("arguments[0].focus()", page.find(BUTTON))
    ActionChains(page.driver).send_keys(Keys.ENTER).perform()
    page.wait_for_text(
        ".collect .refusal", "there is no folder: restart the node with collect_dir set to one"
    )
    assert page.text(".collect .result") == ""
