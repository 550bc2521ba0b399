"""How the page shows the condition of a detector: green only while it detects, lost when nothing is heard."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from support.camera_process import camera_process
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.console_robot import CAMERA
from support.detector_process import NODE, PARAMETERS, as_arguments, detector_process

pytestmark = pytest.mark.long

RATE = re.compile(r"\d Hz")


def condition(page: ConsolePage) -> tuple[str, str, str]:
    """Condition and word of the summary, and the condition in the detector's tab."""
    script = """
        const [summary, tab] = [arguments[0], document.querySelector("nav a")];
        const word = summary.querySelector(".level").textContent;
        return [summary.dataset.condition, word, tab.dataset.condition];
        """
    name, word, of_tab = page.driver.execute_script(script, page.find(".reason"))
    return name, word, of_tab


def wait_for_condition(page: ConsolePage, *expected: str) -> None:
    page.wait_for(lambda: condition(page) == expected, f"{expected}")


def test_only_a_detector_that_detects_is_green(page: ConsolePage) -> None:
    page.wait_for_image()
    wait_for_condition(page, "ok", "ok", "ok")
    assert page.text(".state") == "active"
    page.press("deactivate")
    page.wait_for_state("inactive")
    wait_for_condition(page, "idle", "not detecting", "idle")
    tab = page.driver.find_element(By.CSS_SELECTOR, "nav a")
    assert tab.text.endswith("inactive")
    page.press("cleanup")
    page.wait_for_state("unconfigured")
    wait_for_condition(page, "idle", "not detecting", "idle")
    page.wait_for(lambda: tab.text.endswith("unconfigured"), "the state in the tab")
    assert page.text(".camera .figures") == "not detecting"


def test_an_empty_image_for_a_long_time_is_not_green(page: ConsolePage) -> None:
    page.wait_for_image()
    page.enter("confidence_threshold", "1")
    page.wait_for_text(".reason", "No detection in")
    wait_for_condition(page, "note", "note", "note")


@pytest.fixture
def killed(browser: Chrome) -> Iterator[ConsolePage]:
    """The page of a detector that was detecting until it was killed."""
    with (
        detector_process(*as_arguments(PARAMETERS)) as detector,
        camera_process(detector.domain, *CAMERA),
        console_process(detector.domain) as console,
    ):
        detector.bring_to("active")
        page = ConsolePage(browser, address(console))
        page.open()
        wait_for_condition(page, "ok", "ok", "ok")
        page.wait_for(lambda: RATE.search(page.text(".camera .figures")), "the rate")
        detector.process.stop(signal.SIGKILL)
        page.wait_for_text(".notice.error", f"{NODE} is lost")
        yield page


def test_nothing_of_a_lost_detector_is_shown_as_current(killed: ConsolePage) -> None:
    page = killed
    assert condition(page) == ("lost", "lost", "lost")
    assert page.state == "lost"
    assert page.text(".camera .figures") == "lost"
    assert "Not known now. Last message:" in page.text(".reason")  # of a busy machine, not always the same
    assert page.find_all("[data-transition]") == []
    assert page.find_all('[data-condition="ok"]') == []
    assert [part.text for part in page.find_all(".plot strong")] == ["- Hz", "- ms"]
    assert page.find(".parts").value_of_css_property("filter") == "grayscale(1)"
    headings = 'return getComputedStyle(arguments[0], "::after").content'
    content = page.driver.execute_script(headings, page.find(".diagnostics h2"))
    assert "not current" in content
    tab = page.driver.find_element(By.CSS_SELECTOR, "nav a")
    assert tab.text.endswith("lost")


def test_without_the_console_no_detector_is_shown_as_current(browser: Chrome) -> None:
    with detector_process(*as_arguments(PARAMETERS)) as detector:
        with console_process(detector.domain) as console:
            page = ConsolePage(browser, address(console))
            page.open()
            wait_for_condition(page, "idle", "not detecting", "idle")
            console.stop(signal.SIGKILL)
        wait_for_condition(page, "lost", "lost", "lost")
        assert page.state == "lost"
        assert not page.find(".notice.error").is_displayed()  # it is the console that is lost


STATUSES = {
    "detecting": (DiagnosticStatus.OK, "detecting", "active", "ok"),
    "remark": (DiagnosticStatus.OK, "No detection in ...", "active", "note"),
    "inactive": (DiagnosticStatus.OK, "inactive: activate the node to detect", "inactive", "idle"),
    "older-than-the-state": (DiagnosticStatus.OK, "detecting", "inactive", "idle"),
    "unconfigured": (DiagnosticStatus.OK, "unconfigured: configure ...", "unconfigured", "idle"),
    "finalized": (DiagnosticStatus.OK, "finalized", "finalized", "idle"),
    "warning": (DiagnosticStatus.WARN, "no publisher", "active", "warning"),
    "error": (DiagnosticStatus.ERROR, "the weights are missing", "inactive", "error"),
    "stale": (DiagnosticStatus.STALE, "detecting", "active", "stale"),
}


@pytest.mark.parametrize(("level", "message", "state", "expected"), STATUSES.values(), ids=STATUSES)
def test_a_condition_follows_from_level_message_and_state(
    page: ConsolePage, level: bytes, message: str, state: str, expected: str
) -> None:
    status = {"name": "detection", "level": ord(level), "message": message, "values": {}}
    node = {"state": state, "diagnostics": [status], "cameras": []}
    found = page.driver.execute_async_script(
        "const [node, done] = arguments;"
        "import('/page/condition.js').then(({ summaryOf }) => done(summaryOf(node)));",
        node,
    )
    assert found["name"] == expected
    assert found["symbol"]


def test_an_entry_of_several_lines_is_shown_in_lines(page: ConsolePage) -> None:
    script = """
        import("/page/log_view.js").then(({ LogView }) => {
          const view = new LogView();
          view.update({ log: [{ stamp_s: 1, level: "error", text: "first\\n  second\\nthird" }] });
          document.getElementById("main").append(view.element);
          arguments[0](view.element.querySelector(".text"));
        });
        """
    text = page.driver.execute_async_script(script)
    assert text.text.split("\n") == ["first", "  second", "third"]
