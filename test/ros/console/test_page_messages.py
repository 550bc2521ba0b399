"""The page of twelve detectors with 80 classes, and what it makes of any message, on a phone in a browser."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from urllib.parse import quote

import pytest
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from support.browser import PHONE, set_screen
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.many_detectors import ACTIVE, CLASS_NAMES, NAMES, many_detectors

pytestmark = pytest.mark.long

MAX_BAR_PX = 100
CHIP = '[data-name="class 70"]'
HEARD = """
    window.opened = [];
    window.texts = [];
    window.WebSocket = class extends WebSocket {
      constructor(address) {
        super(address);
        if (address.includes("/image")) {
          const node = new URL(address).searchParams.get("node");
          window.opened.push(node);
          super.addEventListener("close", () => window.opened.splice(window.opened.indexOf(node), 1));
        }
      }
      addEventListener(type, listener) {
        if (type !== "message" || !this.url.endsWith("/ws")) {
          super.addEventListener(type, listener);
          return;
        }
        let isReplaced = false;
        window.deliver = (message) => {
          isReplaced = true;
          listener({ data: JSON.stringify(message) });
        };
        super.addEventListener(type, (event) => {
          window.texts.push(event.data);
          if (!isReplaced) {
            listener(event);
          }
        });
      }
    };
    """
"""`deliver` gives the page a message in place of all further ones of the console, `opened` has the nodes
whose images are open, `texts` what it was sent."""
HOSTILE = "\"'><img src=x onerror=hit=1><script>hit=1</script><a href=javascript:hit=1>"
TAINT = """
    const hostile = arguments[0], fixed = ["type", "change"];
    const tainted = (found) => typeof found === "string" ? `${hostile}.${found}`
      : Array.isArray(found) ? found.map(tainted)
      : found && typeof found === "object" ? Object.fromEntries(Object.entries(found).map(taintedEntry))
      : found;
    const taintedEntry = ([key, found]) => fixed.includes(key) ? [key, found]
      : key === "values" ? [key, Object.fromEntries(Object.entries(found).map((pair) => pair.map(tainted)))]
      : [key, tainted(found)];
    window.WebSocket = class extends WebSocket {
      addEventListener(type, heard) {
        super.addEventListener(type, type !== "message" || !this.url.endsWith("/ws") ? heard : ({ data }) => {
          heard({ data: JSON.stringify(tainted(JSON.parse(data))) });
        });
      }
    };
    """
"""Makes every text that the console sends a page hostile, except those that choose what is shown."""
SCROLLED = """
    const around = (part) => part === null ? [] : [part, ...around(part.parentElement)];
    const isScrolled = (part) => part.scrollHeight > part.clientHeight + 1
      && getComputedStyle(part).overflowY !== "visible";
    return around(arguments[0]).filter(isScrolled).map((part) => part.className);
    """
"""Areas around a part that scroll by themselves, which a phone's page has no room for."""
CONDITIONS: tuple[tuple[Any, ...], ...] = (
    (0, "detecting", "active", "ok", "ok", "✓", "ok"),
    (0, "", "active", "ok", "ok", "✓", "ok"),
    (0, "No detection in ...", "active", "note", "note", "i", "note"),
    (0, "inactive: activate ...", "inactive", "idle", "not detecting", "○", "inactive"),
    (0, "detecting", "inactive", "idle", "not detecting", "○", "inactive"),
    (0, "finalized", "finalized", "idle", "not detecting", "○", "finalized"),
    (1, "no publisher", "active", "warning", "warning", "!", "warning"),
    (2, "weights are missing", "inactive", "error", "error", "✕", "error"),
    (3, "detecting", "active", "stale", "stale", "?", "stale"),
)
"""Level, message and state of a detector; its condition, and the words of summary and tab for it."""
PLACES = (
    "title", "nav a", "main h2", ".state", "[data-transition]", ".camera h3", ".camera .message",
    ".reason .text", ".parameter .name", ".parameter > .hint", ".chip", "option",
    ".diagnostics .subject", ".diagnostics p", ".diagnostics dt", ".diagnostics dd", ".log .text",
    "#missing",
)  # fmt: skip


@pytest.fixture(scope="module")
def console_url(_isolated: None) -> Iterator[str]:
    """Where the page of all detectors is."""
    with many_detectors() as (process, domain), console_process(domain) as console:
        yield address(console)
        process.check_running()


@contextmanager
def injected(driver: Chrome, source: str) -> Iterator[None]:
    """Run `source` in each new page before its own scripts."""
    added = driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": source})
    yield
    driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)


@pytest.fixture
def screen(browser: Chrome) -> Iterator[Chrome]:
    set_screen(browser, PHONE, is_phone=True)
    with injected(browser, HEARD):
        yield browser


def opened_page(screen: Chrome, console_url: str, name: str = "") -> ConsolePage:
    """The page at the address of the detector `name`, with the tabs of all."""
    page = ConsolePage(screen, name or NAMES[0])
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


def test_the_bar_of_twelve_detectors_is_one_row_with_the_shown_one_in_view(
    screen: Chrome, console_url: str
) -> None:
    opened_page(screen, console_url, NAMES[-1]).wait_for_state("unconfigured")
    deliver(screen, type="node", node=node_sent(screen, NAMES[-1]) | {"name": "/another_detector"})
    bar, width = screen.execute_script(
        "return [document.querySelector('.bar').offsetHeight, document.documentElement.scrollWidth]"
    )
    assert bar <= MAX_BAR_PX
    assert width <= PHONE[0]
    tab = screen.find_element(By.CSS_SELECTOR, "nav a[aria-current]")
    assert NAMES[-1] in tab.text  # the tab of another one has come before it
    box = screen.execute_script("return arguments[0].getBoundingClientRect()", tab)
    assert 0 <= box["left"] < box["right"] <= PHONE[0]


def test_only_a_detector_that_detects_is_green_in_summary_and_tab(screen: Chrome, console_url: str) -> None:
    page = opened_page(screen, console_url, ACTIVE)
    page.wait_for_state("active")
    node, colours = node_sent(screen, ACTIVE), dict[str, str]()
    for level, message, state, *shown, symbol, word in CONDITIONS:
        status = node["diagnostics"][0] | {"level": level, "message": message}
        deliver(screen, type="node", node=node | {"state": state, "diagnostics": [status], "cameras": []})
        told, colour = page.condition()
        assert told == [*shown, f"{symbol}{ACTIVE} {word}"]
        assert colours.setdefault(told[0], colour) == colour
    assert colours.pop("stale") == colours["warning"]
    assert len({*colours.values()}) == len(colours)


def test_only_the_image_of_the_detector_in_the_address_is_opened(screen: Chrome, console_url: str) -> None:
    missing = (By.ID, "missing")
    for name in ("", NAMES[0], NAMES[5]):
        page = opened_page(screen, console_url, name)
        page.wait_for(page.find(".state").is_displayed, "the detector")
        assert screen.execute_script("return window.opened") == [name or NAMES[0]]
        assert not screen.find_element(*missing).is_displayed()
    page = opened_page(screen, console_url, "/nowhere")
    page.wait_for(lambda: "/nowhere" in screen.find_element(*missing).text, "the message")
    assert screen.execute_script("return window.opened") == []
    for name in (NAMES[0], NAMES[5]):
        screen.find_element(By.PARTIAL_LINK_TEXT, name).click()
        page.wait_for(lambda: screen.execute_script("return window.opened") == [name], name)  # noqa: B023 - at once
        parts = screen.find_elements(By.CSS_SELECTOR, "article")
        assert [part.get_attribute("data-node") for part in parts if part.is_displayed()] == [name]
    assert not screen.find_element(*missing).is_displayed()


def test_a_class_of_eighty_is_found_by_name_and_selected(screen: Chrome, console_url: str) -> None:
    page = opened_page(screen, console_url, ACTIVE)

    def chips() -> list[str]:
        script = "return Array.from(arguments[0].querySelectorAll('.chip'), (chip) => chip.dataset.name)"
        return list(screen.execute_script(script, page.parameter("classes")))

    page.wait_for(lambda: len(chips()) == len(CLASS_NAMES), "all classes")
    assert screen.execute_script(SCROLLED, page.widget("classes", CHIP)) == []
    field = page.widget("classes", ".find")
    field.send_keys("SS 7")
    assert chips() == ["class 7", *(f"class 7{digit}" for digit in range(10))]
    page.wait_for_text('[data-parameter="classes"] .widget .hint', "11 of 80 found")
    page.widget("classes", CHIP).click()
    page.wait_for(lambda: page.chosen("classes") == ["class 70"], "the chip")
    page.wait_for_text('[data-parameter="classes"] .widget .hint', "1 of 80 selected")
    page.wait_for(lambda: not page.is_busy("classes"), "the answer")
    assert screen.switch_to.active_element.get_attribute("data-name") == "class 70"
    page.widget("classes", CHIP).click()
    page.wait_for(lambda: page.chosen("classes") == [], "no class")


def test_foreign_text_is_text_wherever_it_is_shown(screen: Chrome, console_url: str) -> None:
    source = f"((...arguments) => {{{TAINT}}})({json.dumps(HOSTILE)})"
    screen.get("about:blank")
    with injected(screen, source):
        screen.get(f"{console_url}#{quote(HOSTILE, safe='')}")
    page = ConsolePage(screen)
    script = "return Array.from(document.querySelectorAll(arguments[0]), (part) => part.textContent).join()"

    def is_shown(css: str) -> bool:
        return HOSTILE in screen.execute_script(script, css)

    for css in PLACES:
        page.wait_for(partial(is_shown, css), f"the text in {css}")
    foreign = "img, iframe, script:not([src]), [onerror], [href^=javascript]"
    assert screen.find_elements(By.CSS_SELECTOR, foreign) == []
    assert screen.execute_script("return window.hit") is None


def test_a_detector_that_is_gone_is_shown_as_the_console_tells_it(screen: Chrome, console_url: str) -> None:
    page = opened_page(screen, console_url, ACTIVE)
    page.wait_for_state("active")
    node = node_sent(screen, ACTIVE)
    gone = node | {"class_names": ["late"]}
    gone["log"] = [{"stamp_s": 1, "level": "error", "text": "first\n  second\nthird"}]
    deliver(screen, type="gone", node=gone)
    assert "Its last state was active." in page.text(".notice.error")
    assert page.text(".log .text").split("\n") == ["first", "  second", "third"]
    chips = page.parameter("classes").find_elements(By.CSS_SELECTOR, ".chip")
    assert [chip.text for chip in chips] == ["late"]
    deliver(screen, type="gone", node={**gone, "name": "/brief"})  # was never sent before
    tab = screen.find_element(By.CSS_SELECTOR, f'nav a[href="#{quote("/brief", safe="")}"]')
    assert tab.text.endswith("lost")


def test_a_value_that_is_not_shown_is_not_empty_and_cannot_be_edited(
    screen: Chrome, console_url: str
) -> None:
    page = opened_page(screen, console_url, NAMES[3])
    node = node_sent(screen, NAMES[3])
    names = ["weights", "classes", "iou_threshold", "lazy", "device"]
    hidden = {"value": None, "is_shown": False}
    parameters = [one | hidden if one["name"] in names else one for one in node["parameters"]]
    deliver(screen, type="node", node=node | {"parameters": parameters})
    page.find("button.copy").click()
    text = page.find("textarea").get_attribute("value") or ""
    assert "    # weights: not shown by the console\n" in text
    assert "    weights:" not in text
    for name in names:
        assert page.widget(name, ".widget").text.startswith("not shown: too long for this page")
        controls = page.parameter(name).find_elements(By.CSS_SELECTOR, "input, select, button")
        assert [control for control in controls if control.is_displayed()] == []
    deliver(screen, type="node", node=node)
    for name in names:
        assert page.parameter(name).find_elements(By.CSS_SELECTOR, "input, select") != []
