"""The page on a phone, by keyboard alone, for a screen reader, and in light and dark, in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from selenium.webdriver import ActionChains, Chrome
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from support.browser import DESKTOP, PHONE, axe_source, set_colour_scheme, set_screen
from support.console_page import PATIENCE_S, ConsolePage
from support.console_robot import ConsoleRobot

pytestmark = pytest.mark.long

MAX_STOPS = 400
"""More presses of Tab than the page has stops."""
SERIOUS = ("serious", "critical")


@pytest.fixture
def phone(browser: Chrome, robot: ConsoleRobot) -> Iterator[ConsolePage]:
    """The page with everything opened that can be, on a phone."""
    set_screen(browser, PHONE, is_phone=True)
    page = ConsolePage(browser, robot.url)
    page.open()
    page.wait_for_image()
    open_everything(page)
    yield page
    set_screen(browser, DESKTOP, is_phone=False)


def open_everything(page: ConsolePage) -> None:
    page.find("button.copy").click()
    for summary in page.find_all("details:not([open]) > summary"):
        summary.click()


def test_nothing_is_wider_than_a_phone(phone: ConsolePage) -> None:
    phone.enter("weights", "/nowhere/" + 20 * "a_very_long_name" + ".pt")
    assert phone.refusal("weights")
    width, too_wide = phone.driver.execute_script(
        """
        const isWide = (part) => part.getBoundingClientRect().right > innerWidth + 1;
        const isSeen = (part) => part.checkVisibility() && !part.closest(".scroll");
        const parts = Array.from(document.querySelectorAll("main *, header *")).filter(isSeen);
        return [document.documentElement.scrollWidth, parts.filter(isWide).map((part) => part.outerHTML)];
        """
    )
    assert too_wide == []
    assert width <= PHONE[0]


def test_what_is_touched_on_a_phone_is_large_enough(phone: ConsolePage) -> None:
    small = phone.driver.execute_script(
        """
        const css = "main button, main select, main input, main summary";
        const seen = Array.from(document.querySelectorAll(css)).filter((part) => part.checkVisibility());
        const size = (part) => Math.min(part.offsetWidth, part.offsetHeight);
        return seen.filter((part) => size(part) < 24).map((part) => part.outerHTML);
        """
    )
    assert small == []


def test_every_stop_of_the_keyboard_is_visible_and_has_a_name(page: ConsolePage) -> None:
    open_everything(page)
    stops = list(walked(page))
    assert len(stops) > 40
    assert [stop for stop in stops if not stop["outline"]] == []
    assert [stop for stop in stops if not stop["name"]] == []
    assert [stop for stop in stops if stop["covered"]] == []


def walked(page: ConsolePage) -> Iterator[dict[str, Any]]:
    """What Tab stops at, from the first to the last."""
    page.driver.execute_script("document.querySelector('.skip').focus()")
    for _ in range(MAX_STOPS):
        ActionChains(page.driver).send_keys(Keys.TAB).perform()
        stop = page.driver.execute_script(
            """
            const part = document.activeElement;
            if (part === document.body || part.dataset.walked) return null;
            part.dataset.walked = "yes";
            const { outlineStyle, outlineWidth } = getComputedStyle(part);
            const box = part.getBoundingClientRect();
            const top = document.elementFromPoint(box.left + box.width / 2, box.top + 2);
            return {
              html: part.outerHTML.slice(0, 200),
              outline: outlineStyle !== "none" && parseFloat(outlineWidth) >= 2,
              covered: top !== null && top.closest(".bar") !== null && part.closest(".bar") === null,
            };
            """
        )
        if stop is None:
            return
        yield stop | {"name": page.driver.switch_to.active_element.accessible_name}
    pytest.fail(f"more than {MAX_STOPS} stops")


def test_the_keyboard_alone_steers(robot: ConsoleRobot, page: ConsolePage) -> None:
    def to(css: str) -> None:
        for _ in range(MAX_STOPS):
            if page.driver.execute_script("return document.activeElement.matches(arguments[0])", css):
                return
            ActionChains(page.driver).send_keys(Keys.TAB).perform()
        pytest.fail(f"Tab does not lead to {css}")

    def press(*keys: str) -> None:
        ActionChains(page.driver).send_keys(*keys).perform()

    node = robot.detector.node
    to('[data-parameter="confidence_threshold"] input[type="range"]')
    press(Keys.ARROW_RIGHT)
    page.wait_for(lambda: node.parameter("confidence_threshold") == 0.26, "the slider")
    to('[data-parameter="classes"] [data-name="star"]')
    press(Keys.SPACE)
    page.wait_for(lambda: node.parameter("classes") == ["star"], "the chip")
    to('[data-parameter="agnostic_nms"] input')
    press(Keys.SPACE)
    page.wait_for(lambda: node.parameter("agnostic_nms") is True, "the switch")
    to('[data-group="reload"] > summary')
    press(Keys.ENTER)
    to('[data-parameter="precision"] select')
    press(Keys.ARROW_DOWN)
    press(Keys.ENTER)
    page.wait_for(lambda: node.parameter("precision") == "fp32", "the choice")
    to('[data-transition="deactivate"]')
    press(Keys.ENTER)
    page.wait_for_state("inactive")


def test_a_change_keeps_the_keyboard_where_it_is(page: ConsolePage) -> None:
    page.widget("classes", '[data-name="star"]').click()
    page.wait_for(lambda: page.chosen("classes") == ["star"], "the chip")
    page.wait_for(lambda: not page.is_busy("classes"), "the answer")
    focused = page.driver.switch_to.active_element
    assert focused.get_attribute("data-name") == "star"


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size_wh", [pytest.param(DESKTOP, id="desktop"), pytest.param(PHONE, id="phone")])
def test_axe_finds_nothing_serious(
    browser: Chrome, robot: ConsoleRobot, scheme: str, size_wh: tuple[int, int]
) -> None:
    axe = axe_source()
    set_screen(browser, size_wh, is_phone=size_wh == PHONE)
    set_colour_scheme(browser, scheme)
    page = ConsolePage(browser, robot.url)
    page.open()
    page.wait_for_image()
    assert findings(browser, axe) == []
    open_everything(page)
    page.enter("weights", "/nowhere/model.pt")
    page.widget("classes", '[data-name="star"]').click()
    assert page.refusal("weights")
    page.press("shutdown")
    assert findings(browser, axe) == []
    robot.detector.bring_to("inactive")
    page.wait_for_state("inactive")
    assert findings(browser, axe) == []
    browser.execute_script("document.querySelector('.node').classList.add('old')")
    assert findings(browser, axe) == []


def findings(browser: Chrome, axe: str) -> list[str]:
    """What axe-core calls serious or critical: the rule, and the elements."""
    browser.execute_script(axe)
    browser.set_script_timeout(PATIENCE_S)
    found = browser.execute_async_script("axe.run().then(arguments[0], (e) => arguments[0](String(e)))")
    assert isinstance(found, dict), found
    assert len(found["passes"]) > 10
    return [
        f"{rule['id']}: {node['html']} {node['failureSummary']}"
        for rule in found["violations"]
        if rule["impact"] in SERIOUS
        for node in rule["nodes"]
    ]


def test_the_page_loads_nothing_from_elsewhere_and_breaks_no_rule_of_its_policy(page: ConsolePage) -> None:
    page.wait_for_image()
    entries = "performance.getEntriesByType('resource').map((entry) => entry.name)"
    origin, addresses = page.driver.execute_script(f"return [location.origin, {entries}]")
    assert len(addresses) > 20
    assert [address for address in addresses if not address.startswith(f"{origin}/page/")] == []
    log = page.driver.get_log("browser")  # type: ignore[no-untyped-call]
    assert [entry for entry in log if entry["level"] == "SEVERE"] == []
    assert page.driver.find_elements(By.CSS_SELECTOR, "script:not([src]), style, [style], [onclick]") == []
