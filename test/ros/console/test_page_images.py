"""What the page shows of the cameras, in a browser, of the installed processes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from sensor_msgs.msg import Image
from support.camera_process import camera_process
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.console_robot import ConsoleRobot
from support.detector_process import NODE, detector_process, environment
from support.sighting import Sighting
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.messages import image_of_message, stamp_ns
from yolov5_lifecycle.ros.observer import Observer

pytestmark = pytest.mark.long

LINE_PX = 3
"""How far from the edge of a box its line may be."""
WRITING_PX = 40
"""How far from a box its label may be."""
QUEUE = 500
"""More messages than come while the browser is asked, and nothing is taken."""


def test_the_image_moves(page: ConsolePage) -> None:
    page.wait_for_image()
    first_s, first = page.image()
    page.wait_for_image()
    second_s, second = page.image()
    assert second_s > first_s
    assert np.any(first != second)


def test_the_image_shows_the_boxes_of_its_detections(robot: ConsoleRobot, page: ConsolePage) -> None:
    observer = robot.detector.observer
    page.wait_for_image()
    with (
        kept(observer, Image, f"{NODE}/image_raw") as raw,
        kept(observer, Detection2DArray, f"{NODE}/detections") as found,
    ):
        stamp, shown = shown_and_kept(observer, page, raw, found)
    boxes = Sighting.of(found[stamp]).boxes_xyxy
    pixels = image_of_message(raw[stamp]).pixels[..., ::-1]
    change = np.abs(shown.astype(np.int64) - pixels).max(axis=2)
    near, inside = around(boxes, change.shape, LINE_PX), around(boxes, change.shape, WRITING_PX)
    assert len(boxes) > 2
    assert change[near].mean() > 3 * change[~inside].mean()


@contextmanager
def kept(observer: Observer, message_type: type, topic: str) -> Iterator[dict[int, Any]]:
    """All messages from the first that comes, by their stamps in nanoseconds."""
    messages: dict[int, Any] = {}

    def keep(message: Any) -> None:
        messages[stamp_ns(message.header)] = message

    subscription = observer.create_subscription(message_type, topic, keep, QUEUE)
    try:
        observer.wait_for(lambda: bool(messages), f"a message on {topic}")
        yield messages
    finally:
        observer.destroy_subscription(subscription)


def shown_and_kept(
    observer: Observer, page: ConsolePage, raw: dict[int, Any], found: dict[int, Any]
) -> tuple[int, NDArray[np.uint8]]:
    """Stamp in nanoseconds and pixels of a shown image that has come here, too, with its detections."""

    def looked_at() -> tuple[int, NDArray[np.uint8]] | None:
        stamp_s, shown = page.image()
        observer.wait_for(lambda: min(max(raw), max(found)) > stamp_s * 1e9, "what came after it")
        stamp = nearest(stamp_s, raw)
        return (stamp, shown) if stamp in found else None

    image = page.wait_for(looked_at, "an image that has come here, too")
    assert image is not None
    return image


def nearest(stamp_s: float, messages: dict[int, Any]) -> int:
    """The stamp in nanoseconds that is `stamp_s` as far as a float tells, 0 if there is none."""
    return next((stamp for stamp in messages if abs(stamp / 1e9 - stamp_s) < 1e-5), 0)


def around(boxes_xyxy: NDArray[np.float64], size_hw: tuple[int, ...], reach: int) -> NDArray[np.bool_]:
    """Pixels (H, W) in the frames of boxes that reach so far out and in from their edges."""
    found = np.zeros(size_hw, np.bool_)
    for box in boxes_xyxy:
        x1, y1, x2, y2 = np.rint(box).astype(int)
        found[max(y1 - reach, 0) : y2 + reach, max(x1 - reach, 0) : x2 + reach] = True
        if reach < WRITING_PX:
            found[y1 + reach : y2 - reach, x1 + reach : x2 - reach] = False
    return found


def test_rate_and_latency_are_shown_and_plotted(page: ConsolePage) -> None:
    figures = re.compile(r"\d+\.\d Hz · \d+\.\d ms, p95 \d+\.\d ms")
    page.wait_for(lambda: figures.fullmatch(page.text(".camera .figures")), "the figures")
    page.wait_for(lambda: [bool(line) for line in lines(page)] == [True, True], "both lines")
    first = lines(page)
    page.wait_for(lambda: len(lines(page)[0]) > len(first[0]), "time")


def lines(page: ConsolePage) -> list[str]:
    """The points of each plot, read together: the page draws it again each second."""
    script = """
        const all = (part, css) => Array.from(part.querySelectorAll(css));
        const pointsOf = (plot) => all(plot, "polyline").map((line) => line.getAttribute("points"));
        return all(arguments[0], ".plot").map((plot) => pointsOf(plot).join(" "));
        """
    return list(page.driver.execute_script(script, page.find(".history")))


def test_the_balance_of_frames_grows_and_is_one(page: ConsolePage) -> None:
    def counts() -> dict[str, int]:
        cells = page.driver.execute_script(
            "return Array.from(arguments[0].querySelectorAll('td.number'), (cell) => "
            "[cell.dataset.kind, cell.textContent])",
            page.find(".balance"),
        )
        return {kind: int(re.sub(r"\D", "", text)) for kind, text in cells}

    page.wait_for(lambda: counts().get("detected"), "detected frames")
    first = counts()
    page.wait_for(lambda: counts()["received"] > first["received"], "more frames")
    now = counts()
    assert now["received"] == sum(number for kind, number in now.items() if kind != "received")


def test_a_paused_image_is_not_subscribed_to(robot: ConsoleRobot, page: ConsolePage) -> None:
    observer = robot.detector.observer

    def viewers() -> int:
        return int(observer.count_subscribers(f"{NODE}/image/compressed"))

    page.wait_for_image()
    observer.wait_for(lambda: viewers() == 1, "the console to subscribe")
    page.find(".camera button").click()
    observer.wait_for(lambda: viewers() == 0, "the console to unsubscribe")
    page.wait_for_text(".overlay", "paused")
    page.find(".camera button").click()
    page.wait_for_image()


def test_a_page_that_is_closed_leaves_no_subscription(
    robot: ConsoleRobot, page: ConsolePage, browser: Chrome
) -> None:
    page.wait_for_image()
    browser.get("about:blank")
    observer = robot.detector.observer
    observer.wait_for(lambda: observer.count_subscribers(f"{NODE}/image/compressed") == 0, "no viewer")


def test_each_camera_has_its_image_and_the_reason_why_there_is_none(browser: Chrome) -> None:
    with (
        detector_process("--params-file", "config/two_cameras.yaml") as detector,
        camera_process(detector.domain, "--ros-args", "-r", f"image_raw:={NODE}/front/image_raw"),
        console_process(detector.domain) as console,
    ):
        detector.bring_to("active")
        page = ConsolePage(browser, address(console))
        page.open()
        page.wait_for_image("front")
        page.wait_for_text(
            '[data-camera="rear"] .message', f"no publisher of images on {NODE}/rear/image_raw"
        )
        assert page.stamp_s("rear") == 0
        page.wait_for_text(".reason", "rear: no publisher")


def test_each_detector_has_a_tab_and_only_the_shown_one_sends_images(
    robot: ConsoleRobot, page: ConsolePage
) -> None:
    observer = robot.detector.observer
    command = [entry_point("detector"), "--ros-args", "-r", "__node:=second"]
    with ChildProcess("second detector", command, environment(robot.detector.domain)):
        page.wait_for_image()
        tabs = "nav a"
        page.wait_for(lambda: len(page.driver.find_elements(By.CSS_SELECTOR, tabs)) == 2, "both tabs")
        page.driver.find_element(By.PARTIAL_LINK_TEXT, "/second").click()
        second = ConsolePage(page.driver, robot.url, node="/second")
        second.wait_for_state("unconfigured")
        assert not page.find(".head").is_displayed()
        observer.wait_for(lambda: observer.count_subscribers(f"{NODE}/image/compressed") == 0, "no viewer")
        page.driver.find_element(By.PARTIAL_LINK_TEXT, NODE).click()
        page.wait_for_image()
