"""The page of a detector and its images: lost when nothing is heard of it."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from support.console_page import ConsolePage
from support.console_process import ConsoleClient, address, console_process
from support.detector_process import (
    NODE,
    PARAMETERS,
    as_arguments,
    camera_process,
    environment,
)
from support.page_fixtures import CAMERA, ConsoleRobot, opened
from support.served_node import messages_of
from support.worker import worker_domain

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point

pytestmark = pytest.mark.long


def test_the_image_is_that_of_the_detector_at_its_stamp(robot: ConsoleRobot, page: ConsolePage) -> None:
    sent: dict[float, bytes] = {}
    (result,) = robot.detector.set_one_by_one(messages_of(max_rate=2.0))  # slow enough to see every image
    assert result.successful
    page.wait_for_image()
    with ConsoleClient(robot.url).viewer() as viewer:

        def both() -> tuple[NDArray[np.uint8], bytes] | None:
            sent.update([viewer.receive()])
            viewer.take()
            stamp_s, shown = page.image()
            return (shown, sent[stamp_s]) if stamp_s in sent else None

        found = page.wait_for(both, "an image that has come here, too")
    assert found is not None
    expected = cv2.imdecode(np.frombuffer(found[1], np.uint8), cv2.IMREAD_COLOR)
    assert expected is not None
    assert np.abs(found[0].astype(np.int64) - expected).mean() < 3


def test_rate_and_latency_are_shown_and_plotted(page: ConsolePage) -> None:
    figures = re.compile(r"\d+\.\d Hz · \d+\.\d ms, p95 \d+\.\d ms")
    page.wait_for(lambda: figures.fullmatch(page.text(".camera .figures")), "the figures")
    page.wait_for(lambda: all(lines(page)), "both lines")
    rate = lines(page)[0]
    page.wait_for(lambda: len(lines(page)[0]) > len(rate), "time")


def lines(page: ConsolePage) -> list[str]:
    """The points of each plot, read together: the page draws it again each second."""
    script = """
        const all = (part, css) => Array.from(part.querySelectorAll(css));
        const pointsOf = (plot) => all(plot, "polyline").map((line) => line.getAttribute("points"));
        return all(arguments[0], ".plot").map((plot) => pointsOf(plot).join(" "));
        """
    return list(page.driver.execute_script(script, page.find(".history")))


def test_an_image_that_is_paused_or_closed_is_not_subscribed_to(
    robot: ConsoleRobot, page: ConsolePage
) -> None:
    page.wait_for_image()
    wait_for_viewers(robot, 1)
    page.find(".camera button").click()
    wait_for_viewers(robot, 0)
    page.wait_for_text(".overlay", "paused")
    page.find(".camera button").click()
    page.wait_for_image()
    page.driver.get("about:blank")
    wait_for_viewers(robot, 0)


def wait_for_viewers(robot: ConsoleRobot, count: int) -> None:
    observer, topic = robot.detector.observer, f"{NODE}/image/compressed"
    observer.wait_for(lambda: observer.count_subscribers(topic) == count, f"{count} viewers")


def wait_for_condition(page: ConsolePage, *shown: str) -> None:
    """Wait for the condition, its word in the summary, and the tab."""
    page.wait_for(lambda: page.condition()[0] == [*shown], ", ".join(shown))


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


def test_nothing_of_a_killed_detector_is_shown_as_current_until_it_is_restarted(
    browser: Chrome, domain: int
) -> None:
    with console_process(domain) as console, ExitStack() as first:
        page = ConsolePage(browser)
        browser.get(address(console))
        empty = browser.find_element(By.ID, "empty")
        page.wait_for(lambda: "No detector yet" in empty.text, "the empty page")
        detector = first.enter_context(autostarted(domain))
        page.wait_for_state("active")
        assert not empty.is_displayed()
        page.wait_for_image()
        wait_for_condition(page, "ok", "ok", f"✓{NODE} ok")
        detector.stop(signal.SIGKILL)
        page.wait_for_text(".notice.error", f"{NODE} is lost")
        wait_for_condition(page, "lost", "lost", f"✕{NODE} lost")
        assert (page.state, page.text(".camera .figures")) == ("lost", "lost")
        assert "Not known now. Last message:" in page.text(".reason")  # which depends on the machine
        assert page.find_all('[data-transition], [data-condition="ok"]') == []
        assert not page.find(".collect").is_displayed()
        assert [part.text for part in page.find_all(".plot strong")] == ["- Hz", "- ms"]
        assert page.find(".parts").value_of_css_property("filter") == "grayscale(1)"
        headings = 'return getComputedStyle(arguments[0], "::after").content'
        assert "not current" in page.driver.execute_script(headings, page.find(".diagnostics h2"))
        with autostarted(domain):
            page.wait_for(lambda: not page.find(".notice.error").is_displayed(), "the detector")
            page.wait_for_state("active")
            page.wait_for_image()


def test_without_the_console_nothing_is_shown_as_current_until_it_is_restarted(
    browser: Chrome, domain: int
) -> None:
    port = 7400 + 250 * domain  # nobody takes it while no console has it: no ephemeral one, of this domain
    with autostarted(domain), ExitStack() as first:
        console = first.enter_context(console_process(domain, port=port))
        page = opened(browser, address(console))
        page.wait_for_image()
        console.stop(signal.SIGKILL)
        lost = browser.find_element(By.ID, "lost")
        page.wait_for(lambda: "connection to the console is lost" in lost.text, "the loss")
        wait_for_condition(page, "lost", "lost", f"✕{NODE} lost")
        assert not page.find(".notice.error").is_displayed()  # it is the console that is lost
        field = page.widget("max_rate", 'input[type="text"]')
        page.enter("max_rate", "3")
        assert "not sent" in page.refusal("max_rate")
        with console_process(domain, port=port):
            page.wait_for(lambda: not lost.is_displayed(), "the console")
            page.wait_for_state("active")
            page.wait_for_image()
            assert field.get_attribute("value") == "0"


def test_a_token_opens_the_page_and_another_one_is_refused(
    browser: Chrome, robot: ConsoleRobot, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.mktemp("state") / "token"
    with console_process(robot.detector.domain, "--host", "0.0.0.0", "--token-file", str(file)) as console:
        page = ConsolePage(browser)
        browser.get(f"http://127.0.0.1:{urlsplit(address(console)).port}/")
        log_in(browser, "0" * 43)
        page.wait_for(lambda: "not the token" in browser.find_element(By.ID, "refused").text, "the refusal")
        log_in(browser, "\u2603")
        page.wait_for(lambda: "cannot be" in browser.find_element(By.ID, "refused").text, "the refusal")
        log_in(browser, file.read_text().strip())
        page.wait_for_state("active")
        page.wait_for_image()


def log_in(browser: Chrome, token: str) -> None:
    field = browser.find_element(By.ID, "token")
    field.clear()
    field.send_keys(token)
    browser.find_element(By.CSS_SELECTOR, "form button").click()
