"""The page on a phone, by touch, by keyboard alone, for a screen reader, in light and dark, in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from selenium.webdriver import ActionChains, Chrome
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from support.browser import (
    DESKTOP,
    PHONE,
    Finger,
    Point,
    axe_source,
    middle,
    set_colour_scheme,
    set_screen,
)
from support.console_page import PATIENCE_S, ConsolePage
from support.page_fixtures import ConsoleRobot, opened

pytestmark = pytest.mark.long

MAX_STOPS = 400
"""More presses of Tab than the page has stops."""
SERIOUS = ("serious", "critical")
SLIDER = 'input[type="range"]'
THUMB_PX = 32
WIDGETS = {
    "iou_threshold": SLIDER,
    "image_size": SLIDER,
    "max_detections": 'input[type="text"]',
    "agnostic_nms": ".switch",
    "tracker": "select",
    "classes": '[data-name="star"]',
}
STEERING = (
    *(f'[data-parameter="{name}"] {css}' for name, css in WIDGETS.items()),
    *('[data-group="reload"] > summary', '[data-transition="deactivate"]'),
)
"""What the keyboard must come to; test_page_steering.py changes one of each kind with keys."""


def open_everything(page: ConsolePage) -> None:
    page.find("button.copy").click()
    for summary in page.find_all("details:not([open]) > summary"):
        summary.click()


def test_nothing_is_wider_than_a_phone_or_too_small_to_be_touched(phone: ConsolePage) -> None:
    phone.wait_for_image()
    open_everything(phone)
    phone.enter("weights", "/nowhere/" + 20 * "a_very_long_name" + ".pt")
    assert phone.refusal("weights")
    width, too_wide, too_small = phone.driver.execute_script(
        """
        const all = Array.from(document.querySelectorAll("main *, header *"));
        const seen = all.filter((part) => part.checkVisibility());
        const right = (part) => part.getBoundingClientRect().right;
        const isWide = (part) => right(part) > innerWidth + 1 && !part.closest(".scroll");
        const isSmall = (part) => Math.min(part.offsetWidth, part.offsetHeight) < 24;
        const touched = seen.filter((part) => part.matches("main :is(button, select, input, summary)"));
        const found = [seen.filter(isWide), touched.filter(isSmall)];
        const texts = found.map((parts) => parts.map((part) => part.outerHTML));
        return [document.documentElement.scrollWidth, ...texts];
        """
    )
    assert too_wide == too_small == []
    assert width <= PHONE[0]


def test_every_stop_of_the_keyboard_is_visible_and_has_a_name(page: ConsolePage) -> None:
    open_everything(page)
    stops = list(walked(page))
    assert {css for stop in stops for css in stop["steers"]} == {*STEERING}
    assert [stop for stop in stops if not stop["outline"] or not stop["name"] or stop["covered"]] == []


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
              steers: arguments[0].filter((css) => part.closest(css) !== null),
              outline: outlineStyle !== "none" && parseFloat(outlineWidth) >= 2,
              covered: top !== null && top.closest(".bar") !== null && part.closest(".bar") === null,
            };
            """,
            STEERING,
        )
        if stop is None:
            return
        yield stop | {"name": page.driver.switch_to.active_element.accessible_name}
    pytest.fail(f"more than {MAX_STOPS} stops")


@pytest.mark.parametrize(
    ("scheme", "size_wh"),
    [pytest.param("light", DESKTOP, id="light-desktop"), pytest.param("dark", PHONE, id="dark-phone")],
)
def test_axe_finds_nothing_serious(
    browser: Chrome, robot: ConsoleRobot, scheme: str, size_wh: tuple[int, int]
) -> None:
    axe = axe_source()
    set_screen(browser, size_wh, is_phone=size_wh == PHONE)
    set_colour_scheme(browser, scheme)
    page = opened(browser, robot.url)
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
    browser.execute_script("document.querySelector('.node').classList.add('old')")
    assert findings(browser, axe) == []
    set_screen(browser, DESKTOP, is_phone=False)


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
    assert len(addresses) > 15
    assert [address for address in addresses if not address.startswith(f"{origin}/page/")] == []
    log = page.driver.get_log("browser")  # type: ignore[no-untyped-call]
    assert [entry for entry in log if entry["level"] == "SEVERE"] == []
    assert page.driver.find_elements(By.CSS_SELECTOR, "script:not([src]), style, [style], [onclick]") == []


class Touched:
    """The page on a phone; every request of it is kept."""

    def __init__(self, page: ConsolePage, robot: ConsoleRobot) -> None:
        self.page = page
        self.node = robot.detector.node
        self.finger = Finger(page.driver)
        page.driver.execute_script(
            """
            window.sent = [];
            const send = WebSocket.prototype.send;
            WebSocket.prototype.send = function (data) {
              if (typeof data === "string" && data.startsWith("{")) window.sent.push(data);
              return send.call(this, data);
            };
            """
        )

    @property
    def sent(self) -> list[str]:
        """What the page has requested."""
        wait_for_frames(self.page)
        return list(self.page.driver.execute_script("return window.sent"))

    def place(self, name: str, css: str = SLIDER) -> Point:
        """The middle of a widget, scrolled to."""
        return middle(self.page.widget(name, css))

    def thumb(self, name: str) -> Point:
        """The middle of the part of a slider that a finger moves."""
        x, y = self.place(name)
        script = "const s = arguments[0]; return [s.offsetWidth, (s.value - s.min) / (s.max - s.min)]"
        width, part = self.page.driver.execute_script(script, self.page.widget(name, SLIDER))
        return x + (part - 0.5) * (width - THUMB_PX), y

    def wait_for_value(self, name: str, is_right: Any) -> None:
        self.page.wait_for(lambda: is_right(self.node.parameter(name)), f"the value of {name}")


@pytest.fixture
def touched(phone: ConsolePage, robot: ConsoleRobot) -> Touched:
    return Touched(phone, robot)


def wait_for_frames(page: ConsolePage) -> None:
    """Wait until everything that the browser was given has been handled."""
    frames = "requestAnimationFrame(() => requestAnimationFrame(() => arguments[0]()))"
    page.driver.execute_async_script(frames)


def shown(page: ConsolePage) -> list[str]:
    """What every widget shows."""
    script = """
        const parts = arguments[0].querySelectorAll("input:not([type=search]), select, .chip");
        return Array.from(parts, (part) => `${part.value} ${part.checked} ${part.ariaPressed}`);
        """
    return list(page.driver.execute_script(script, page.find(".parameters")))


def scrolled(page: ConsolePage) -> float:
    parts = "document.querySelector('.parameters').scrollTop + document.scrollingElement.scrollTop"
    return float(page.driver.execute_script(f"return {parts}"))


def test_swipes_and_taps_change_nothing(touched: Touched) -> None:
    page, finger = touched.page, touched.finger
    before = shown(page)
    for name, css in WIDGETS.items():
        start = touched.place(name, css)
        begin = scrolled(page)
        finger.swipe(start, (15, -240))
        page.wait_for(lambda: scrolled(page) != begin, "the page to scroll")  # noqa: B023 - called at once
    finger.swipe(touched.thumb("iou_threshold"), (15, -240))
    x, y = touched.thumb("iou_threshold")
    finger.drag([(x, y), (x, y - 40), (x + 80, y - 40)])
    finger.lift()
    x, y = touched.thumb("iou_threshold")
    finger.tap((x + 40, y))
    finger.swipe((x + 40, y), (50, 3))
    touched.wait_for_value("iou_threshold", lambda value: value == 0.45)
    page.wait_for(lambda: shown(page) == before, "the old values")
    assert all("iou_threshold" in text for text in touched.sent)  # from the edge of the thumb


def test_a_horizontal_drag_moves_the_slider_and_so_does_the_keyboard_after_it(touched: Touched) -> None:
    touched.finger.swipe(touched.thumb("iou_threshold"), (50, 3))
    shown = float(touched.page.widget("iou_threshold", SLIDER).get_attribute("value") or 0)
    assert shown > 0.55
    touched.wait_for_value("iou_threshold", lambda value: value == shown)
    touched.finger.swipe(touched.place("confidence_threshold"), (0, -200))
    touched.page.widget("confidence_threshold", SLIDER).send_keys(Keys.ARROW_RIGHT)
    touched.wait_for_value("confidence_threshold", lambda value: value == 0.26)


def test_a_slider_that_reloads_is_set_once_where_the_finger_is_lifted(touched: Touched) -> None:
    x, y = touched.thumb("image_size")
    touched.finger.drag([(x, y), (x + 40, y)])
    assert touched.sent == []
    touched.finger.lift()
    touched.wait_for_value("image_size", lambda value: value != 320)
    assert len(touched.sent) == 1


def test_a_drag_that_is_cut_off_is_taken_back(touched: Touched) -> None:
    x, y = touched.thumb("iou_threshold")
    touched.finger.drag([(x, y), (x + 50, y)])
    touched.wait_for_value("iou_threshold", lambda value: value > 0.55)
    touched.finger.lift(is_cancelled=True)
    touched.wait_for_value("iou_threshold", lambda value: value == 0.45)
    before = touched.sent
    x, y = touched.thumb("image_size")
    touched.finger.drag([(x, y), (x + 40, y)])
    touched.finger.lift(is_cancelled=True)
    slider = touched.page.widget("image_size", SLIDER)
    touched.page.wait_for(lambda: slider.get_attribute("value") == "320", "the value that is set")
    assert touched.sent == before
