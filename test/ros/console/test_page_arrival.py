"""What the page makes of the console's messages, in whatever order they arrive, in a browser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from support.browser import PHONE, chromium, set_screen
from support.console_page import ConsolePage
from support.console_process import ConsoleClient, address, console_process
from support.many_detectors import ACTIVE, NAMES, many_detectors

pytestmark = pytest.mark.long

LONG = [f"/a_robot_with_a_long_name/a_detector_with_a_long_name_{number}" for number in range(8)]
MAX_NOTICE_PX = 100
LAST_FIRST = """
    window.opened = [];
    window.texts = [];
    window.WebSocket = class extends WebSocket {
      constructor(address) {
        super(address);
        if (address.includes("/image")) {
          window.opened.push(new URL(address).searchParams.get("node"));
        }
      }
      addEventListener(type, listener) {
        if (type !== "message" || !this.url.endsWith("/ws")) {
          super.addEventListener(type, listener);
          return;
        }
        const held = [];
        let isReplaced = false;
        window.deliver = (message) => {
          isReplaced = true;
          listener({ data: JSON.stringify(message) });
        };
        super.addEventListener(type, (event) => {
          const message = JSON.parse(event.data);
          window.texts.push(event.data);
          if (isReplaced) {
            return;
          }
          if (message.type === "node" && message.node.name !== LAST) {
            held.push(event);
          } else {
            listener(event);
            held.splice(0).forEach(listener);
          }
        });
      }
    };
    """.replace("LAST", repr(NAMES[-1]))
"""The page gets the last detector before the others; `deliver` gives it a message in place of all
further ones of the console, `opened` has the nodes whose images it has opened, `texts` what it was sent."""


@pytest.fixture(scope="module")
def console_url(_isolated: None) -> Iterator[str]:
    with many_detectors() as (process, domain), console_process(domain) as console:
        with ConsoleClient(address(console)).page() as page:
            page.wait_for(lambda: len(page.nodes) == len(NAMES), "all detectors")
        yield address(console)
        process.check_running()


@pytest.fixture
def screen(tmp_path: Path) -> Iterator[Chrome]:
    with chromium(tmp_path) as driver:
        set_screen(driver, PHONE, is_phone=True)
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": LAST_FIRST})
        yield driver


def opened_page(screen: Chrome, console_url: str, name: str = "") -> ConsolePage:
    """The page at the address of the detector `name`, with the tabs of all."""
    page = ConsolePage(screen, console_url, node=name or NAMES[0])
    screen.get("about:blank")
    screen.get(f"{console_url}#{quote(name, safe='')}")
    page.wait_for(lambda: len(screen.find_elements(By.CSS_SELECTOR, "nav a")) == len(NAMES), "all tabs")
    return page


def deliver(screen: Chrome, **message: Any) -> None:
    screen.execute_script("window.deliver(arguments[0])", message)


def node_sent(screen: Chrome, name: str) -> dict[str, Any]:
    """The detector as the console has sent it."""
    script = """
        const sent = window.texts.map((text) => JSON.parse(text)).filter(({ type }) => type === "node");
        return sent.map(({ node }) => node).filter(({ name }) => name === arguments[0]).at(-1);
        """
    return dict(screen.execute_script(script, name))


@pytest.mark.parametrize("name", ["", NAMES[0], NAMES[5]], ids=["no-name", "first", "middle"])
def test_only_the_image_of_the_announced_detector_is_opened(
    screen: Chrome, console_url: str, name: str
) -> None:
    page = opened_page(screen, console_url, name)
    page.wait_for(lambda: page.find(".state").is_displayed(), "the detector")
    assert screen.execute_script("return window.opened") == [name or NAMES[0]]
    assert not screen.find_element(By.ID, "missing").is_displayed()


def test_the_tab_of_the_shown_detector_stays_in_view(screen: Chrome, console_url: str) -> None:
    opened_page(screen, console_url, NAMES[-1])  # the tabs of the others come before it
    tab = screen.find_element(By.CSS_SELECTOR, "nav a[aria-current]")
    box = screen.execute_script("return arguments[0].getBoundingClientRect()", tab)
    assert 0 <= box["left"] < box["right"] <= PHONE[0]


def test_a_detector_that_is_gone_is_shown_as_the_console_tells_it(screen: Chrome, console_url: str) -> None:
    page = opened_page(screen, console_url, ACTIVE)
    page.wait_for_state("active")
    node = node_sent(screen, ACTIVE)
    gone = {**node, "state": "lost", "last_state": "active", "transitions": [], "class_names": ["late"]}
    deliver(screen, type="gone", name=ACTIVE, node=gone)
    assert page.state == "lost"
    assert "Its last state was active." in page.text(".notice.error")
    assert page.find_all('[data-condition="ok"]') == page.find_all("[data-transition]") == []
    chips = page.parameter("classes").find_elements(By.CSS_SELECTOR, ".chip")
    assert [chip.text for chip in chips] == ["late"]


def test_a_detector_that_was_never_sent_is_shown_once_it_is_gone(screen: Chrome, console_url: str) -> None:
    opened_page(screen, console_url)
    gone = {**node_sent(screen, ACTIVE), "name": "/brief", "state": "lost", "transitions": []}
    deliver(screen, type="gone", name="/brief", node=gone)
    tab = screen.find_element(By.CSS_SELECTOR, f'nav a[href="#{quote("/brief", safe="")}"]')
    assert tab.text.endswith("lost")


@pytest.mark.parametrize(
    ("count", "names", "expected"),
    [
        pytest.param(1, ["/a"], "1 further node is left out.*: /a. ", id="one"),
        pytest.param(
            40, LONG, f"40 further nodes are left out.*: {', '.join(LONG)} and 32 more. ", id="many"
        ),
    ],
)
def test_nodes_that_are_left_out_are_named_until_there_are_none(
    screen: Chrome, console_url: str, count: int, names: list[str], expected: str
) -> None:
    opened_page(screen, console_url)
    omitted = screen.find_element(By.ID, "omitted")
    assert not omitted.is_displayed()
    deliver(screen, type="omitted", count=count, names=names)
    assert re.match(expected, omitted.text)
    assert omitted.size["height"] <= MAX_NOTICE_PX
    assert screen.execute_script("return document.documentElement.scrollWidth") <= PHONE[0]
    deliver(screen, type="omitted", count=0, names=[])
    assert not omitted.is_displayed()


@pytest.mark.parametrize("name", ["weights", "classes", "iou_threshold", "lazy", "device"])
def test_a_value_that_is_not_shown_is_not_empty_and_cannot_be_edited(
    screen: Chrome, console_url: str, name: str
) -> None:
    page = opened_page(screen, console_url, NAMES[3])
    deliver(screen, type="node", node=with_hidden(node_sent(screen, NAMES[3]), name))
    assert page.widget(name, ".widget").text.startswith("not shown: too long for this page")
    controls = page.parameter(name).find_elements(By.CSS_SELECTOR, "input, select, button")
    assert [control for control in controls if control.is_displayed()] == []
    deliver(screen, type="node", node=node_sent(screen, NAMES[3]))
    assert page.parameter(name).find_elements(By.CSS_SELECTOR, "input, select") != []


def test_the_copied_text_names_values_that_are_not_shown(screen: Chrome, console_url: str) -> None:
    page = opened_page(screen, console_url, NAMES[3])
    deliver(screen, type="node", node=with_hidden(node_sent(screen, NAMES[3]), "weights"))
    page.find("button.copy").click()
    text = page.find("textarea").get_attribute("value") or ""
    assert "    # weights: not shown by the console\n" in text
    assert "    weights:" not in text


def with_hidden(node: dict[str, Any], name: str) -> dict[str, Any]:
    """`node` with a value of the parameter that is not shown."""
    hidden = {"value": None, "is_shown": False}
    return node | {"parameters": [one | hidden if one["name"] == name else one for one in node["parameters"]]}
