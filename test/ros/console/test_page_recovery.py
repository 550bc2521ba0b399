"""What the page says when a process is lost, and that it goes on by itself, in a browser."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from urllib.parse import urlsplit

import pytest
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from support.camera_process import camera_process
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.console_robot import CAMERA
from support.detector_process import PARAMETERS, as_arguments, environment
from support.worker import worker_domain

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point

pytestmark = pytest.mark.long


@contextmanager
def autostarted(domain: int) -> Iterator[ChildProcess]:
    """A detector that activates itself."""
    words = as_arguments({**PARAMETERS, "autostart": True})
    command = [entry_point("detector"), "--ros-args", *words]
    with ChildProcess("detector", command, environment(domain)) as process:
        yield process


@pytest.fixture
def domain() -> Iterator[int]:
    with worker_domain() as domain, camera_process(domain, *CAMERA):
        yield domain


def own_port(domain: int) -> int:
    """A TCP port that nobody takes while no console has it: no ephemeral one, and of this domain."""
    return 7400 + 250 * domain


def test_a_detector_that_is_killed_and_restarted_is_lost_and_found(browser: Chrome, domain: int) -> None:
    with console_process(domain) as console, ExitStack() as first:
        detector = first.enter_context(autostarted(domain))
        page = ConsolePage(browser, address(console))
        page.open()
        page.wait_for_image()
        detector.stop(signal.SIGKILL)
        page.wait_for_text(".notice.error", "/yolov5 is lost")
        page.wait_for_state("lost")
        with autostarted(domain):
            page.wait_for(lambda: not page.find(".notice.error").is_displayed(), "the detector")
            page.wait_for_state("active")
            page.wait_for_image()


def test_a_console_that_is_killed_and_restarted_is_lost_and_found(browser: Chrome, domain: int) -> None:
    port = own_port(domain)
    with autostarted(domain), ExitStack() as first:
        console = first.enter_context(console_process(domain, port=port))
        page = ConsolePage(browser, address(console))
        page.open()
        page.wait_for_image()
        console.stop(signal.SIGKILL)
        lost = browser.find_element(By.ID, "lost")
        page.wait_for(lambda: "connection to the console is lost" in lost.text, "the loss")
        field = page.widget("max_rate", 'input[type="text"]')
        page.enter("max_rate", "3")
        assert "not sent" in page.refusal("max_rate")
        with console_process(domain, port=port):
            page.wait_for(lambda: not lost.is_displayed(), "the console")
            page.wait_for_state("active")
            page.wait_for_image()
            assert field.get_attribute("value") == "0"


def test_without_a_detector_the_page_says_so(browser: Chrome, domain: int) -> None:
    with console_process(domain) as console:
        page = ConsolePage(browser, address(console))
        browser.get(address(console))
        empty = browser.find_element(By.ID, "empty")
        page.wait_for(lambda: "No detector yet" in empty.text, "the empty page")
        with autostarted(domain):
            page.wait_for_state("active")
            assert not empty.is_displayed()


def test_a_token_opens_the_page_and_another_one_is_refused(
    browser: Chrome, domain: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.mktemp("state") / "token"
    options = ["--host", "0.0.0.0", "--token-file", str(file)]
    with autostarted(domain), console_process(domain, *options) as console:
        port = urlsplit(address(console)).port
        page = ConsolePage(browser, f"http://127.0.0.1:{port}/")
        browser.get(f"http://127.0.0.1:{port}/")
        log_in(browser, "0" * 43)
        page.wait_for(lambda: "not the token" in browser.find_element(By.ID, "refused").text, "the refusal")
        log_in(browser, file.read_text().strip())
        page.wait_for_state("active")
        page.wait_for_image()


def log_in(browser: Chrome, token: str) -> None:
    browser.find_element(By.ID, "token").send_keys(token)
    browser.find_element(By.CSS_SELECTOR, "form button").click()
