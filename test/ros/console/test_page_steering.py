"""What a person changes on the page and takes back, in a browser, with the installed processes."""

from __future__ import annotations

from pathlib import Path

import pytest
from rcl_interfaces.srv import ListParameters
from selenium.webdriver import Chrome
from selenium.webdriver.common.keys import Keys
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.detector_process import NODE, Sighting
from support.page_fixtures import ConsoleRobot, console_robot, opened

from yolov5_lifecycle.collecting.collected_files import kept_images

pytestmark = pytest.mark.long

SLIDER = 'input[type="range"]'
TEXT = 'input[type="text"]'
HOSTILE = "<img src=x onerror=document.title='caught'><b>"


def wait_for_detections(robot: ConsoleRobot, of: set[str]) -> None:
    """Wait for an image in which exactly these classes were found."""
    robot.detector.detections.clear()

    def is_so() -> bool:
        found = robot.detector.detections[-1:]
        return bool(found) and set(Sighting.of(found[0]).class_names) == of

    robot.detector.observer.wait_for(is_so, f"detections of {of}")


def wait_for_value(robot: ConsoleRobot, page: ConsolePage, name: str, value: object) -> None:
    page.wait_for(lambda: robot.detector.node.parameter(name) == value, f"{name} to be {value}")


@pytest.mark.end_to_end
def test_a_slider_changes_the_next_detections(robot: ConsoleRobot, page: ConsolePage) -> None:
    page.wait_for_image()
    page.widget("confidence_threshold", SLIDER).send_keys(Keys.END)
    wait_for_detections(robot, set())
    assert robot.detector.node.parameter("confidence_threshold") == 1.0
    page.reset("confidence_threshold")
    wait_for_detections(robot, {"circle", "square", "triangle", "star"})
    assert robot.detector.node.parameter("confidence_threshold") == 0.25


def test_chips_choose_classes_and_none_is_lost_while_a_change_is_sent(
    robot: ConsoleRobot, page: ConsolePage
) -> None:
    names = ["star", "circle", "square"]
    chips = [page.widget("classes", f'[data-name="{name}"]') for name in names]
    page.driver.execute_script("for (const chip of arguments[0]) chip.click()", chips)
    wait_for_value(robot, page, "classes", names)
    assert set(page.chosen("classes")) == set(names)
    chips[1].click()
    wait_for_detections(robot, {"star", "square"})


def test_a_refused_value_shows_the_nodes_words_as_text_and_the_old_value(page: ConsolePage) -> None:
    page.widget("classes", TEXT).send_keys(HOSTILE, Keys.ENTER)
    assert HOSTILE in page.refusal("classes")
    page.wait_for(lambda: page.chosen("classes") == [], "the old value")
    assert page.find_all("img, b") == []
    assert page.driver.title == f"{NODE} - Detector console"
    page.enter("iou_threshold", "half")
    assert page.refusal("iou_threshold") == "'half' is not a number"
    page.enter("iou_threshold", "7")
    page.wait_for_text('[data-parameter="iou_threshold"] .refusal', "7.0 is not a number from 0 to 1.")
    field = page.widget("iou_threshold", TEXT)
    page.wait_for(lambda: field.get_attribute("value") == "0.45", "the old value")


def test_a_detector_is_deactivated_and_a_refused_transition_shows_the_nodes_reason(
    robot: ConsoleRobot, page: ConsolePage
) -> None:
    page.press("deactivate")
    page.wait_for_state("inactive")
    assert robot.detector.node.state() == "inactive"
    page.wait_for_text(".reason", "activate the node to detect")
    page.wait_for_text(".camera .figures", "not detecting")
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


def test_a_reload_shows_that_it_is_prepared(robot: ConsoleRobot, page: ConsolePage) -> None:
    # Every text of the spinner is kept: some are shorter than a look at them.
    page.driver.execute_script(
        """
        const spinner = arguments[0].querySelector(".spinner");
        window.busyTexts = [];
        new MutationObserver(() => window.busyTexts.push(spinner.textContent))
          .observe(spinner, { childList: true, characterData: true, subtree: true });
        """,
        page.parameter("image_size"),
    )
    page.enter("image_size", "256")
    wait_for_value(robot, page, "image_size", 256)
    page.wait_for(lambda: not page.is_busy("image_size"), "the new model")
    assert "loading the new model" in " ".join(page.driver.execute_script("return window.busyTexts"))
    assert page.state == "active"


def test_a_console_for_viewing_has_no_controls(browser: Chrome, robot: ConsoleRobot) -> None:
    with console_process(robot.detector.domain, "--view-only") as console:
        page = opened(browser, address(console))
        page.wait_for_image()
        assert page.find_all("[data-transition], .collect") == []
        assert page.find_all(".parameter input, .parameter select, .parameter button:not([hidden])") == []
        page.wait_for_text('[data-parameter="confidence_threshold"] output', "0.25")


def test_a_parameter_is_found_by_its_meaning(page: ConsolePage) -> None:
    def visible() -> list[str]:
        parts = [part for part in page.find_all("[data-parameter]") if part.is_displayed()]
        return [part.get_attribute("data-parameter") or "" for part in parts]

    page.find('input[type="search"]').send_keys("sha-256")
    page.wait_for(lambda: visible() == ["weights_sha256"], "one parameter")


def test_an_image_that_is_asked_for_is_kept_and_the_page_says_so(browser: Chrome, tmp_path: Path) -> None:
    with console_robot(collect_dir=tmp_path, collect=False, collect_min_free_mb=0) as robot:
        page = opened(browser, robot.url)
        page.wait_for_image()
        button = page.find(".collect button")
        assert button.text == "Keep this image"
        button.send_keys(Keys.ENTER)
        page.wait_for_text(
            ".collect .refusal", "no camera collects: activate the node, and set collect to true"
        )
        assert robot.detector.node.set_parameters(collect=True) == ""
        button.click()
        page.wait_for_text(".collect .result", "the next image is kept")
        assert page.text(".collect .refusal") == ""
        page.wait_for(
            lambda: any("requested" in frame.reasons for _, frame in kept_images(tmp_path)),
            "the image",
        )


def test_changes_of_every_widget_are_taken_back_to_what_was_when_the_page_was_opened(
    browser: Chrome, robot: ConsoleRobot
) -> None:
    changes: list[tuple[str, object, str, tuple[str, ...], object]] = [
        ("confidence_threshold", 0.5, SLIDER, (Keys.END,), 1.0),
        ("max_rate", 9.0, TEXT, (Keys.BACKSPACE, "7.5", Keys.ENTER), 7.5),
        ("agnostic_nms", True, "input", (Keys.SPACE,), False),
        ("classes", ["circle"], '[data-name="star"]', (Keys.ENTER,), ["circle", "star"]),
        ("precision", "fp32", "select", ("auto",), "auto"),
    ]
    assert robot.detector.node.set_parameters(**{name: before for name, before, *_ in changes}) == ""
    page = opened(browser, robot.url)
    for name, before, css, keys, after in changes:
        page.widget(name, css).send_keys(*keys)
        wait_for_value(robot, page, name, after)
        back = page.widget(name, ".back")
        page.wait_for(back.is_displayed, "the button")
        back.click()
        wait_for_value(robot, page, name, before)
    page.wait_for(lambda: page.widget("max_rate", TEXT).get_attribute("value") == "9", "the old value")


def test_escape_restores_a_text_and_a_button_keeps_the_keyboard(
    robot: ConsoleRobot, page: ConsolePage
) -> None:
    field = page.widget("max_rate", TEXT)
    field.send_keys("9", Keys.ESCAPE)
    assert field.get_attribute("value") == "0"
    page.widget("classes", '[data-name="star"]').click()
    wait_for_value(robot, page, "classes", ["star"])
    button = page.widget("classes", ".reset")
    page.wait_for(button.is_displayed, "the button")
    assert button.accessible_name == "Set classes to its default"
    button.send_keys(Keys.ENTER)
    wait_for_value(robot, page, "classes", [])
    page.wait_for(lambda: page.chosen("classes") == [], "no class")
    assert page.driver.switch_to.active_element == button


def test_a_camera_has_its_own_image_reason_and_value_of_a_parameter(browser: Chrome) -> None:
    camera = ("--ros-args", "-r", f"image_raw:={NODE}/front/image_raw")
    with console_robot("--params-file", "config/two_cameras.yaml", camera=camera) as robot:
        page = opened(browser, robot.url)
        page.wait_for_image("front")
        page.wait_for_text(
            '[data-camera="rear"] .message', f"no publisher of images on {NODE}/rear/image_raw"
        )
        assert page.stamp_s("rear") == 0
        page.wait_for_text(".reason", "rear: no publisher")
        name = "rear.max_rate"
        page.enter(name, "4")
        wait_for_value(robot, page, name, 4.0)
        page.reset(name)
        observer = robot.detector.observer
        client = observer.create_client(ListParameters, f"{NODE}/list_parameters")

        def listed() -> list[str]:
            return list(observer.call(client, ListParameters.Request()).result.names)

        page.wait_for(lambda: name not in listed(), "no override")
