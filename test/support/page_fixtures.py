"""Fixtures of the tests of the console's page, which `conftest.py` names as a plugin."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
from selenium.webdriver import Chrome

from support.browser import DESKTOP, PHONE, chromium, set_screen
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.detector_process import (
    NODE,
    PARAMETERS,
    DetectorProcess,
    as_arguments,
    camera_process,
    detector_process,
)

CAMERA = (
    *("--ros-args", "-r", f"image_raw:={NODE}/image_raw", "-p", "seed:=8", "-p", "rate:=15.0"),
    *("-p", "width:=320", "-p", "height:=240"),
)


@dataclass(frozen=True)
class ConsoleRobot:
    """Camera, detector and console in a ROS domain of their own; `url` is that of the page."""

    detector: DetectorProcess
    url: str


@contextmanager
def console_robot(
    *words: str, camera: tuple[str, ...] = CAMERA, **parameters: object
) -> Iterator[ConsoleRobot]:
    """An active detector with `parameters` or else the ROS arguments `words`."""
    with (
        detector_process(*(words or as_arguments(PARAMETERS | parameters))) as detector,
        camera_process(detector.domain, *camera),
        console_process(detector.domain) as console,
    ):
        detector.bring_to("active")
        yield ConsoleRobot(detector, address(console))


def opened(browser: Chrome, url: str) -> ConsolePage:
    """The page of an active detector."""
    browser.get(url)
    page = ConsolePage(browser)
    page.wait_for_state("active")
    return page


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chrome]:
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


@pytest.fixture(scope="module")
def shared_robot(browser: Chrome, _isolated: None) -> Iterator[ConsoleRobot]:
    """Camera, detector and console; `robot` has them as at the start. Not begun without a browser."""
    with console_robot() as robot:
        yield robot


@pytest.fixture
def robot(shared_robot: ConsoleRobot) -> ConsoleRobot:
    """An active detector, its parameters as at the start."""
    shared_robot.detector.reset()
    shared_robot.detector.bring_to("active")
    return shared_robot


@pytest.fixture
def page(browser: Chrome, robot: ConsoleRobot) -> ConsolePage:
    return opened(browser, robot.url)


@pytest.fixture
def phone(browser: Chrome, robot: ConsoleRobot) -> Iterator[ConsolePage]:
    """The page on a phone."""
    set_screen(browser, PHONE, is_phone=True)
    yield opened(browser, robot.url)
    set_screen(browser, DESKTOP, is_phone=False)
