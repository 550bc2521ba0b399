"""Scrolling and zooming with fingers on the page changes no parameter of a real detector, in a browser."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from support.browser import DESKTOP, PHONE, set_screen
from support.console_page import ConsolePage
from support.console_robot import ConsoleRobot
from support.finger import Finger, Point, middle, set_touch_screen, turn_wheel

pytestmark = pytest.mark.long

SLIDER = 'input[type="range"]'
EVERYTHING = {
    "slider-of-a-double": ("iou_threshold", SLIDER),
    "slider-of-an-integer": ("max_detections", SLIDER),
    "slider-that-reloads": ("image_size", SLIDER),
    "number": ("iou_threshold", 'input[type="text"]'),
    "switch": ("agnostic_nms", ".switch"),
    "choice": ("tracker", "select"),
    "chip": ("classes", '[data-name="star"]'),
}


@pytest.fixture
def phone(browser: Chrome, robot: ConsoleRobot) -> Iterator[ConsolePage]:
    """The page on a phone; every request of it is kept in the page's `sent`."""
    set_screen(browser, PHONE, is_phone=True)
    set_touch_screen(browser, is_on=True)
    page = ConsolePage(browser, robot.url)
    page.open()
    page.wait_for_state("active")
    browser.execute_script(
        """
        window.sent = [];
        const send = WebSocket.prototype.send;
        WebSocket.prototype.send = function (data) {
          if (typeof data === "string" && data.startsWith("{")) window.sent.push(data);
          return send.call(this, data);
        };
        """
    )
    yield page
    set_touch_screen(browser, is_on=False)
    set_screen(browser, DESKTOP, is_phone=False)


def sent(page: ConsolePage) -> list[str]:
    """What the page has requested, after everything that the browser was given has been handled."""
    frames = "requestAnimationFrame(() => requestAnimationFrame(() => arguments[0](window.sent)))"
    return list(page.driver.execute_async_script(frames))


def scrolled(page: ConsolePage) -> float:
    return float(page.driver.execute_script("return document.scrollingElement.scrollTop"))


def place(page: ConsolePage, name: str, css: str = SLIDER) -> Point:
    """The middle of a widget, scrolled to."""
    return middle(page.widget(name, css))


@pytest.mark.parametrize("way_px", [pytest.param(-240, id="up"), pytest.param(240, id="down")])
@pytest.mark.parametrize(("name", "css"), EVERYTHING.values(), ids=EVERYTHING)
def test_a_vertical_swipe_scrolls_and_changes_nothing(
    phone: ConsolePage, name: str, css: str, way_px: float
) -> None:
    start = place(phone, name, css)
    before = shown(phone)
    begin = scrolled(phone)
    Finger(phone.driver).swipe(start, (15, way_px))
    phone.wait_for(lambda: scrolled(phone) != begin, "the page to scroll")
    assert sent(phone) == []
    assert shown(phone) == before


def shown(page: ConsolePage) -> list[str]:
    """What every widget shows."""
    script = """
        const parts = arguments[0].querySelectorAll("input:not([type=search]), select, .chip");
        return Array.from(parts, (part) => `${part.value} ${part.checked} ${part.ariaPressed}`);
        """
    return list(page.driver.execute_script(script, page.find(".parameters")))


def test_a_swipe_that_begins_up_and_goes_on_to_the_side_changes_nothing(phone: ConsolePage) -> None:
    x, y = place(phone, "iou_threshold")
    before = shown(phone)
    finger = Finger(phone.driver)
    finger.drag([(x, y), (x, y - 40), (x + 80, y - 40)])
    finger.lift()
    assert sent(phone) == []
    assert shown(phone) == before


def test_a_tap_on_a_slider_changes_nothing(phone: ConsolePage) -> None:
    x, y = place(phone, "iou_threshold")
    before = shown(phone)
    Finger(phone.driver).tap((x + 40, y))
    assert sent(phone) == []
    assert shown(phone) == before


def test_a_horizontal_drag_moves_the_slider(robot: ConsoleRobot, phone: ConsolePage) -> None:
    Finger(phone.driver).swipe(place(phone, "iou_threshold"), (50, 3))
    phone.wait_for(lambda: robot.detector.node.parameter("iou_threshold") > 0.55, "the value")
    assert float(phone.widget("iou_threshold", SLIDER).get_attribute("value") or 0) > 0.55


def test_a_slider_that_reloads_is_set_once_where_the_finger_is_lifted(
    robot: ConsoleRobot, phone: ConsolePage
) -> None:
    finger = Finger(phone.driver)
    x, y = place(phone, "image_size")
    finger.drag([(x, y), (x - 40, y)])
    assert sent(phone) == []
    finger.lift()
    phone.wait_for(lambda: robot.detector.node.parameter("image_size") != 320, "the value")
    assert len(sent(phone)) == 1


@pytest.mark.parametrize(
    "is_cancelled", [pytest.param(True, id="touchcancel"), pytest.param(False, id="pinch")]
)
def test_a_drag_that_is_cut_off_is_taken_back(
    robot: ConsoleRobot, phone: ConsolePage, *, is_cancelled: bool
) -> None:
    finger = Finger(phone.driver)
    x, y = place(phone, "iou_threshold")
    finger.drag([(x, y), (x + 50, y)])
    phone.wait_for(lambda: robot.detector.node.parameter("iou_threshold") > 0.55, "the value")
    if is_cancelled:
        finger.cancel()
    else:
        finger.touch((x + 50, y), (x - 30, y + 90))
        finger.move((x + 70, y), (x - 60, y + 120))
        finger.lift()
    phone.wait_for(lambda: robot.detector.node.parameter("iou_threshold") == 0.45, "the old value")
    assert not phone.find(".undo").is_displayed()


def test_a_pinch_changes_nothing(phone: ConsolePage) -> None:
    finger = Finger(phone.driver)
    x, y = place(phone, "iou_threshold")
    before = shown(phone)
    finger.touch((x, y), (x + 30, y))
    for step in range(1, 8):
        finger.move((x - 8 * step, y), (x + 30 + 8 * step, y))
    finger.lift()
    assert sent(phone) == []
    assert shown(phone) == before


def test_after_a_swipe_the_keyboard_moves_the_slider(robot: ConsoleRobot, phone: ConsolePage) -> None:
    Finger(phone.driver).swipe(place(phone, "confidence_threshold"), (0, -200))
    phone.widget("confidence_threshold", SLIDER).send_keys(Keys.ARROW_RIGHT)
    phone.wait_for(lambda: robot.detector.node.parameter("confidence_threshold") == 0.26, "the value")


@pytest.mark.parametrize(("name", "css"), EVERYTHING.values(), ids=EVERYTHING)
def test_the_wheel_over_a_widget_changes_nothing(page: ConsolePage, name: str, css: str) -> None:
    part = page.widget(name, css)
    page.driver.execute_script("arguments[0].focus()", part)
    before = shown(page)
    turn_wheel(page.driver, middle(part), 240)
    list_scrolled = (
        "return document.querySelector('.parameters').scrollTop + document.scrollingElement.scrollTop"
    )
    page.wait_for(lambda: page.driver.execute_script(list_scrolled) > 0, "something to scroll")
    assert shown(page) == before
    assert page.driver.find_elements(By.CSS_SELECTOR, ".undo:not([hidden])") == []
