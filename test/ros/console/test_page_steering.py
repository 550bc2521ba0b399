"""What a person changes on the page, in a browser, with the installed processes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium.webdriver import Chrome
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.console_robot import ConsoleRobot
from support.detector_process import NODE, PARAMETERS, detector_process
from support.sighting import Sighting

from yolov5_lifecycle.settings.parameter_file import read_parameter_file
from yolov5_lifecycle.settings.settings import SETTINGS

pytestmark = pytest.mark.long

SLIDER = 'input[type="range"]'


def wait_for_detections(robot: ConsoleRobot, of: set[str]) -> None:
    """Wait for an image in which exactly these classes were found."""
    robot.detector.detections.clear()

    def is_so() -> bool:
        found = robot.detector.detections[-1:]
        return bool(found) and set(Sighting.of(found[0]).class_names) == of

    robot.detector.observer.wait_for(is_so, f"detections of {of}")


@pytest.mark.end_to_end
def test_a_slider_changes_the_next_detections(robot: ConsoleRobot, page: ConsolePage) -> None:
    page.wait_for_image()
    page.widget("confidence_threshold", SLIDER).send_keys(Keys.END)
    wait_for_detections(robot, set())
    assert robot.detector.node.parameter("confidence_threshold") == 1.0
    page.reset("confidence_threshold")
    wait_for_detections(robot, {"circle", "square", "triangle", "star"})
    assert robot.detector.node.parameter("confidence_threshold") == 0.25


def test_chips_choose_classes(robot: ConsoleRobot, page: ConsolePage) -> None:
    page.wait_for_image()
    page.widget("classes", '[data-name="star"]').click()
    wait_for_detections(robot, {"star"})
    page.widget("classes", '[data-name="circle"]').click()
    wait_for_detections(robot, {"circle", "star"})
    assert page.chosen("classes") == ["circle", "star"]


def test_chips_that_are_pressed_while_a_change_is_sent_are_not_lost(
    robot: ConsoleRobot, page: ConsolePage
) -> None:
    names = ["star", "circle", "square"]
    chips = [page.widget("classes", f'[data-name="{name}"]') for name in names]
    page.driver.execute_script("for (const chip of arguments[0]) chip.click()", chips)
    page.wait_for(lambda: robot.detector.node.parameter("classes") == names, "all three classes")
    assert set(page.chosen("classes")) == set(names)


def test_a_camera_gets_its_own_value_of_a_parameter(browser: Chrome) -> None:
    with (
        detector_process("--params-file", "config/two_cameras.yaml") as detector,
        console_process(detector.domain) as console,
    ):
        detector.bring_to("active")
        page = ConsolePage(browser, address(console))
        page.open()
        override(page, "rear", "confidence_threshold")
        page.wait_for(lambda: page.find('[data-parameter="rear.confidence_threshold"]'), "the new parameter")
        assert detector.node.parameter("rear.confidence_threshold") == 0.25
        page.enter("rear.confidence_threshold", "0.75")
        page.wait_for(lambda: detector.node.parameter("rear.confidence_threshold") == 0.75, "the new value")
        assert detector.node.parameter("confidence_threshold") == 0.25
        offered = {option.get_attribute("value") for option in names(page).options}
        per_camera = {setting.name for setting in SETTINGS if setting.per_camera}
        assert offered == per_camera - {"max_rate", "confidence_threshold"}


def override(page: ConsolePage, camera: str, name: str) -> None:
    """Choose the camera and the parameter, and press the button."""
    page.wait_for(lambda: page.find(".override").is_displayed(), "the form")
    Select(page.find('.override [data-choice="camera"]')).select_by_value(camera)
    names(page).select_by_value(name)
    page.find(".override button").click()


def names(page: ConsolePage) -> Select:
    """The parameters that the chosen camera can override."""
    return Select(page.find('.override [data-choice="parameter"]'))


def test_a_wrong_class_shows_the_nodes_refusal_and_the_old_value(page: ConsolePage) -> None:
    field = page.widget("classes", 'input[type="text"]')
    field.send_keys("circel", Keys.ENTER)
    assert "Did you mean 'circle'?" in page.refusal("classes")
    page.wait_for(lambda: page.chosen("classes") == [], "the old value")


def test_what_comes_from_elsewhere_is_text(page: ConsolePage) -> None:
    hostile = "<img src=x onerror=document.title='caught'><b>"
    page.widget("classes", 'input[type="text"]').send_keys(hostile, Keys.ENTER)
    assert hostile in page.refusal("classes")
    page.enter("weights", hostile)
    assert hostile in page.refusal("weights")
    page.wait_for_text(".log .lines", hostile)
    assert page.find_all("img, b") == []
    assert page.driver.title == f"{NODE} - Detector console"


def test_a_number_outside_of_its_range_is_refused_in_the_nodes_words(page: ConsolePage) -> None:
    page.enter("iou_threshold", "7")
    assert page.refusal("iou_threshold") == (
        "iou_threshold: 7.0 is not a number from 0 to 1. The default is 0.45."
    )
    field = page.widget("iou_threshold", 'input[type="text"]')
    page.wait_for(lambda: field.get_attribute("value") == "0.45", "the old value")


def test_what_is_no_number_is_not_sent(page: ConsolePage) -> None:
    page.enter("iou_threshold", "half")
    assert page.refusal("iou_threshold") == "'half' is not a number"


def test_a_detector_is_deactivated_and_activated(robot: ConsoleRobot, page: ConsolePage) -> None:
    page.press("deactivate")
    page.wait_for_state("inactive")
    assert robot.detector.node.state() == "inactive"
    page.wait_for_text(".reason", "activate the node to detect")
    page.press("activate")
    page.wait_for_state("active")
    page.wait_for_image()


def test_a_refused_transition_shows_the_nodes_reason(page: ConsolePage) -> None:
    page.press("deactivate")
    page.wait_for_state("inactive")
    page.enter("weights", "/nowhere/model.pt")
    page.wait_for(lambda: not page.is_busy("weights"), "the answer")
    page.press("activate")
    page.wait_for_text(".head .refusal", "/nowhere/model.pt")
    assert page.state == "inactive"


def test_shutdown_asks_first(robot: ConsoleRobot, page: ConsolePage) -> None:
    page.press("shutdown")
    assert "Ends the process" in page.text(".confirmation")
    page.find(".confirmation button:last-child").click()
    assert page.text(".confirmation") == ""
    assert robot.detector.node.state() == "active"


def test_a_reload_shows_that_it_is_prepared_and_then_the_new_value(
    robot: ConsoleRobot, page: ConsolePage
) -> None:
    record_busy(page, "image_size")
    page.enter("image_size", "256")
    page.wait_for(lambda: busy_texts(page), "the spinner")
    page.wait_for(lambda: not page.is_busy("image_size"), "the new model")
    assert "loading the new model" in " ".join(busy_texts(page))
    assert robot.detector.node.parameter("image_size") == 256
    assert page.state == "active"
    page.wait_for_image()


def record_busy(page: ConsolePage, name: str) -> None:
    """Keep every text of the parameter's spinner: some are shorter than a look at them."""
    page.driver.execute_script(
        """
        const spinner = arguments[0].querySelector(".spinner");
        window.busyTexts = [];
        new MutationObserver(() => window.busyTexts.push(spinner.textContent))
          .observe(spinner, { childList: true, characterData: true, subtree: true });
        """,
        page.parameter(name),
    )


def busy_texts(page: ConsolePage) -> list[str]:
    return list(page.driver.execute_script("return window.busyTexts.filter(Boolean)"))


def test_a_refused_reload_brings_the_old_value_back(page: ConsolePage) -> None:
    before = page.widget("weights", "input").get_attribute("value")
    page.enter("weights", "/nowhere/model.pt")
    assert "/nowhere/model.pt" in page.refusal("weights")
    page.wait_for(lambda: page.widget("weights", "input").get_attribute("value") == before, "the old value")
    assert page.state == "active"


@pytest.fixture
def second(page: ConsolePage, robot: ConsoleRobot) -> Iterator[ConsolePage]:
    """Another tab of the same browser."""
    driver = page.driver
    first = driver.current_window_handle
    driver.switch_to.new_window("tab")
    other = ConsolePage(driver, robot.url)
    other.open()
    yield other
    driver.close()
    driver.switch_to.window(first)


def test_two_tabs_agree(page: ConsolePage, second: ConsolePage) -> None:
    driver = page.driver
    tab = driver.current_window_handle
    second.widget("agnostic_nms", "input").click()
    second.enter("max_rate", "7.5")
    second.press("deactivate")
    second.wait_for_state("inactive")
    (first,) = set(driver.window_handles) - {tab}
    driver.switch_to.window(first)
    page.wait_for_state("inactive")
    page.wait_for(lambda: page.widget("agnostic_nms", "input").is_selected(), "the switch")
    field = page.widget("max_rate", 'input[type="text"]')
    page.wait_for(lambda: field.get_attribute("value") == "7.5", "the number")
    driver.switch_to.window(tab)


def test_the_yaml_is_what_differs_and_a_file_of_parameters(
    robot: ConsoleRobot, page: ConsolePage, tmp_path: Path
) -> None:
    page.widget("classes", '[data-name="star"]').click()
    page.enter("max_rate", "7")
    page.wait_for(lambda: robot.detector.node.parameter("max_rate") == 7.0, "the rate")
    page.wait_for(lambda: page.chosen("classes") == ["star"], "the chip")

    def copied() -> str:
        page.find("button.copy").click()
        text = page.find(".yaml textarea").get_attribute("value") or ""
        return text if "max_rate" in text else ""  # the page learns of it after the node has it

    text = page.wait_for(copied, "the rate in the text")
    expected = {**PARAMETERS, "classes": ["star"], "max_rate": 7.0}
    (tmp_path / "copied.yaml").write_text(text)
    assert read_parameter_file(tmp_path / "copied.yaml") == {"/**": expected}


def test_a_console_for_viewing_has_no_controls(browser: Chrome, robot: ConsoleRobot) -> None:
    with console_process(robot.detector.domain, "--view-only") as console:
        page = ConsolePage(browser, address(console))
        page.open()
        page.wait_for_image()
        assert page.find_all("[data-transition], .collect") == []
        assert page.find_all(".parameter input, .parameter select, .parameter button:not([hidden])") == []
        page.wait_for_text('[data-parameter="confidence_threshold"] output', "0.25")


def test_a_parameter_is_found_by_its_meaning(page: ConsolePage) -> None:
    page.find('input[type="search"]').send_keys("sha-256")
    page.wait_for(lambda: visible_parameters(page) == ["weights_sha256"], "one parameter")


def visible_parameters(page: ConsolePage) -> list[str]:
    parts = [part for part in page.find_all("[data-parameter]") if part.is_displayed()]
    return [part.get_attribute("data-parameter") or "" for part in parts]
