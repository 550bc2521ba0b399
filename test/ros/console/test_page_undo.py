"""Changes of the page are taken back with a button or a key, in a browser, with the installed processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from rcl_interfaces.srv import ListParameters
from selenium.webdriver import ActionChains, Chrome
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.console_robot import ConsoleRobot
from support.detector_process import NODE, DetectorProcess, detector_process
from support.finger import Finger, middle, set_touch_screen

pytestmark = pytest.mark.long

SLIDER = 'input[type="range"]'
Change = Callable[[ConsolePage], None]


def press_undo(page: ConsolePage) -> None:
    page.wait_for(lambda: page.find(".undo button").is_displayed(), "the button")
    page.find(".undo button").click()


def chip(page: ConsolePage) -> None:
    page.widget("classes", '[data-name="star"]').click()


def addition(page: ConsolePage) -> None:
    page.widget("class_thresholds", 'input[type="text"]').send_keys("star:0.5")
    page.widget("class_thresholds", ".addition button").click()


def choose(page: ConsolePage) -> None:
    Select(page.widget("precision", "select")).select_by_value("fp32")


CHANGES = {
    "slider": ("confidence_threshold", lambda page: slide(page, Keys.END), 1.0),
    "number": ("max_rate", lambda page: page.enter("max_rate", "7.5"), 7.5),
    "integer": ("max_detections", lambda page: page.enter("max_detections", "20"), 20),
    "switch": ("agnostic_nms", lambda page: page.widget("agnostic_nms", "input").click(), True),
    "chip": ("classes", chip, ["star"]),
    "entry-that-is-added": ("class_thresholds", addition, ["star:0.5"]),
    "choice-that-reloads": ("precision", choose, "fp32"),
}


def slide(page: ConsolePage, key: str) -> None:
    page.widget("confidence_threshold", SLIDER).send_keys(key)


@pytest.mark.parametrize(("name", "change", "after"), CHANGES.values(), ids=CHANGES)
def test_a_change_is_undone(
    robot: ConsoleRobot, page: ConsolePage, name: str, change: Change, after: object
) -> None:
    node = robot.detector.node
    before = node.parameter(name)
    change(page)
    page.wait_for(lambda: node.parameter(name) == after, "the change")
    page.wait_for_text(".undo .change", f"{name} changed from")
    press_undo(page)
    page.wait_for(lambda: node.parameter(name) == before, "the old value")
    page.wait_for_text(".undo .change", f"{name} is")


def test_a_reset_to_the_default_is_undone(robot: ConsoleRobot, page: ConsolePage) -> None:
    node = robot.detector.node
    page.enter("max_rate", "7.5")
    page.wait_for(lambda: node.parameter("max_rate") == 7.5, "the change")
    page.reset("max_rate")
    page.wait_for(lambda: node.parameter("max_rate") == 0.0, "the default")
    page.wait_for_text(".undo .change", "max_rate changed from 7.5 to 0.")
    press_undo(page)
    page.wait_for(lambda: node.parameter("max_rate") == 7.5, "the old value")


def test_changes_are_undone_one_after_the_other(robot: ConsoleRobot, page: ConsolePage) -> None:
    node = robot.detector.node
    page.enter("max_rate", "5")
    page.wait_for_text(".undo .change", "max_rate changed from 0 to 5")
    page.enter("max_rate", "6")
    page.wait_for_text(".undo .change", "max_rate changed from 5 to 6")
    chip(page)
    page.wait_for_text(".undo .change", "classes changed from empty to star")
    assert page.text(".undo button") == "Undo (3)"
    for name, value in (("classes", []), ("max_rate", 5.0), ("max_rate", 0.0)):
        press_undo(page)
        page.wait_for(lambda: node.parameter(name) == value, f"{name} to be {value}")  # noqa: B023
        page.wait_for(lambda: page.find(".undo").get_attribute("aria-busy") == "false", "the answer")
    assert page.text(".undo .change") == "max_rate is 0 again."


def test_the_widget_shows_the_old_value_at_once(page: ConsolePage) -> None:
    page.enter("max_rate", "5")
    page.wait_for_text(".undo .change", "max_rate changed from 0 to 5")
    press_undo(page)
    page.wait_for_text(".undo .change", "max_rate is 0 again.")
    assert page.widget("max_rate", 'input[type="text"]').get_attribute("value") == "0"


def test_a_drag_is_one_change(robot: ConsoleRobot, page: ConsolePage) -> None:
    slider = page.widget("iou_threshold", SLIDER)
    drag = ActionChains(page.driver).click_and_hold(slider).move_by_offset(20, 0)
    drag.pause(0.3).move_by_offset(20, 0).pause(0.3).move_by_offset(-10, 0).release().perform()
    page.wait_for_text(".undo .change", "iou_threshold changed from 0.45")
    page.wait_for(lambda: not page.is_busy("iou_threshold"), "the answer")
    assert page.text(".undo button") == "Undo"
    press_undo(page)
    page.wait_for(lambda: robot.detector.node.parameter("iou_threshold") == 0.45, "the old value")


def test_what_the_node_refused_is_nothing_to_undo(page: ConsolePage) -> None:
    page.enter("iou_threshold", "7")
    assert page.refusal("iou_threshold")
    assert not page.find(".undo").is_displayed()


def test_a_refused_undo_shows_the_reason_and_stays(robot: ConsoleRobot, page: ConsolePage) -> None:
    chip(page)
    page.wait_for_text(".undo .change", "classes changed from empty to star")
    page.widget("classes", '[data-name="circle"]').click()
    page.wait_for_text(".undo .change", "classes changed from star to star, circle")
    page.driver.execute_script(
        """
        const send = WebSocket.prototype.send;
        WebSocket.prototype.send = function (data) {
          send.call(this, data.replace('["star"]', '["circel"]'));
        };
        """
    )
    press_undo(page)
    page.wait_for_text(".undo .refusal", "Did you mean 'circle'?")
    assert page.text(".undo .change") == "classes changed from star to star, circle."
    assert robot.detector.node.parameter("classes") == ["star", "circle"]


def test_the_keyboard_undoes_a_change_but_typing_stays_the_fields(
    robot: ConsoleRobot, page: ConsolePage
) -> None:
    node = robot.detector.node
    slide(page, Keys.END)
    page.wait_for_text(".undo .change", "confidence_threshold changed from 0.25 to 1.")
    field = page.widget("max_rate", 'input[type="text"]')
    field.send_keys("9", Keys.CONTROL + "z")
    assert field.get_attribute("value") == "0"
    assert node.parameter("confidence_threshold") == 1.0
    field.send_keys(Keys.ESCAPE)
    page.driver.find_element(By.CSS_SELECTOR, "main").send_keys(Keys.CONTROL + "z")
    page.wait_for(lambda: node.parameter("confidence_threshold") == 0.25, "the old value")


def test_undo_has_a_name_that_says_what_it_does_and_keeps_the_keyboard(page: ConsolePage) -> None:
    chip(page)
    page.wait_for_text(".undo .change", "classes changed")
    button = page.find(".undo button")
    assert button.accessible_name == "Undo: set classes to empty"
    assert page.find(".undo .change").aria_role == "status"
    button.send_keys(Keys.ENTER)
    page.wait_for_text(".undo .change", "classes is empty again.")
    assert page.driver.switch_to.active_element == button
    assert button.get_attribute("aria-disabled") == "true"


def test_after_the_last_change_was_undone_by_touch_the_bar_goes(page: ConsolePage) -> None:
    set_touch_screen(page.driver, is_on=True)
    try:
        chip(page)
        page.wait_for_text(".undo .change", "classes changed")
        Finger(page.driver).tap(middle(page.find(".undo button")))
        page.wait_for_text(".undo .change", "classes is empty again.")
        assert not page.find(".undo button").is_displayed()
        page.wait_for(lambda: not page.find(".undo").is_displayed(), "the end of the report")
    finally:
        set_touch_screen(page.driver, is_on=False)


@pytest.fixture
def cameras(browser: Chrome) -> Iterator[tuple[DetectorProcess, ConsolePage]]:
    """A detector with the cameras front and rear, and its page."""
    with (
        detector_process("--params-file", "config/two_cameras.yaml") as detector,
        console_process(detector.domain) as console,
    ):
        detector.bring_to("active")
        page = ConsolePage(browser, address(console))
        page.open()
        page.wait_for_state("active")
        yield detector, page


def test_an_override_that_was_not_there_is_removed_again(
    cameras: tuple[DetectorProcess, ConsolePage],
) -> None:
    detector, page = cameras
    page.wait_for(lambda: page.find(".override").is_displayed(), "the form")
    Select(page.find('.override [data-choice="camera"]')).select_by_value("rear")
    Select(page.find('.override [data-choice="parameter"]')).select_by_value("confidence_threshold")
    page.find(".override button").click()
    page.wait_for_text(".undo .change", "rear.confidence_threshold changed from not set to 0.25")
    press_undo(page)
    page.wait_for_text(".undo .change", "rear.confidence_threshold is not set again.")
    client = detector.observer.create_client(ListParameters, f"{NODE}/list_parameters")
    listed = detector.observer.call(client, ListParameters.Request()).result.names
    assert "rear.max_rate" in listed
    assert "rear.confidence_threshold" not in listed
