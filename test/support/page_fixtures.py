"""Fixtures of the tests of the console's page, which `conftest.py` names as a plugin."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from selenium.webdriver import Chrome

from support.browser import chromium
from support.console_page import ConsolePage
from support.console_robot import ConsoleRobot, console_robot


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
    shared_robot.reset()
    return shared_robot


@pytest.fixture
def page(browser: Chrome, robot: ConsoleRobot) -> ConsolePage:
    """The page of an active detector."""
    page = ConsolePage(browser, robot.url)
    page.open()
    page.wait_for_state("active")
    return page
