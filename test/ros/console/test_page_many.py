"""The page of twelve detectors with 80 classes, on a phone and a desktop, in a browser."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from urllib.parse import quote

import pytest
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from support.browser import PHONE, chromium, set_screen
from support.console_page import ConsolePage
from support.console_process import address, console_process
from support.many_detectors import ACTIVE, CLASS_NAMES, NAMES, REFUSED, UNCONFIGURED, many_detectors

pytestmark = pytest.mark.long

MAX_BAR_PX = 100
CHIP = '[data-name="class 70"]'
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
          heard({ data: JSON.stringify({ type: "omitted", count: 1, names: [hostile] }) });
        });
      }
    };
    """
"""Makes every text that the console sends a page hostile, except those that choose what is shown."""
PLACES = (
    "title", "nav a", "main h2", ".state", "[data-transition]", ".camera h3", ".camera .message",
    ".reason .text", ".parameter .name", ".parameter > .hint", ".chip", "option",
    ".diagnostics .subject", ".diagnostics p", ".diagnostics dt", ".diagnostics dd", ".log .text",
    "#omitted", "#missing",
)  # fmt: skip


@pytest.fixture(scope="module")
def console_url(_isolated: None) -> Iterator[str]:
    """Where the page of all detectors is."""
    with many_detectors() as (process, domain), console_process(domain) as console:
        yield address(console)
        process.check_running()


@pytest.fixture
def screen(tmp_path: Path) -> Iterator[Chrome]:
    """A phone whose pages keep the addresses of their WebSockets in `opened`."""
    with chromium(tmp_path) as driver:
        set_screen(driver, PHONE, is_phone=True)
        record = """
            window.opened = [];
            window.WebSocket = class extends WebSocket {
              constructor(address) {
                super(address);
                window.opened.push(decodeURIComponent(address));
              }
            };
            """
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": record})
        yield driver


def opened_page(screen: Chrome, console_url: str, name: str) -> ConsolePage:
    """The page at the address of the detector, with the tabs of all."""
    page = ConsolePage(screen, f"{console_url}#{quote(name, safe='')}", node=name)
    screen.get(f"{console_url}#{quote(name, safe='')}")
    page.wait_for(lambda: len(screen.find_elements(By.CSS_SELECTOR, "nav a")) == len(NAMES), "all tabs")
    return page


def images(screen: Chrome) -> list[str]:
    """Queries of the images that the page has opened."""
    opened = screen.execute_script("return window.opened")
    return [found.partition("?")[2] for found in opened if "/image" in found]


def test_the_bar_of_twelve_detectors_is_one_row_on_a_phone(screen: Chrome, console_url: str) -> None:
    opened_page(screen, console_url, NAMES[-1]).wait_for_state("unconfigured")
    assert screen.execute_script("return document.querySelector('.bar').offsetHeight") <= MAX_BAR_PX
    assert screen.execute_script("return document.documentElement.scrollWidth") <= PHONE[0]
    tab = screen.find_element(By.CSS_SELECTOR, "nav a[aria-current]")
    assert NAMES[-1] in tab.text
    left, right = screen.execute_script(
        "const b = arguments[0].getBoundingClientRect(); return [b.left, b.right]", tab
    )
    assert left >= 0
    assert right <= PHONE[0]


def test_every_tab_tells_how_its_detector_is(screen: Chrome, console_url: str) -> None:
    page = opened_page(screen, console_url, ACTIVE)
    tabs = dict(zip(NAMES, screen.find_elements(By.CSS_SELECTOR, "nav a"), strict=True))
    page.wait_for(lambda: shown(tabs[REFUSED]) == f"✕{REFUSED} error", "the error")
    without_camera = {f"i{ACTIVE} note", f"!{ACTIVE} warning"}  # it is warned of after a while
    page.wait_for(lambda: shown(tabs[ACTIVE]) in without_camera, "the active one, which has no camera")
    assert shown(tabs[UNCONFIGURED]) == f"○{UNCONFIGURED} unconfigured"
    colour = "return getComputedStyle(arguments[0].querySelector('.word')).color"
    colours = [screen.execute_script(colour, tabs[name]) for name in (REFUSED, ACTIVE, UNCONFIGURED)]
    assert len(set(colours)) == 3


def shown(tab: WebElement) -> str:
    return tab.get_attribute("textContent") or ""


@pytest.mark.parametrize("name", [NAMES[0], NAMES[5], NAMES[-1]])
def test_only_the_image_of_the_detector_in_the_address_is_opened(
    screen: Chrome, console_url: str, name: str
) -> None:
    opened_page(screen, console_url, name).wait_for_state("active" if name == ACTIVE else "unconfigured")
    assert images(screen) == [f"node={name}&camera="]


def test_the_address_of_an_unknown_detector_opens_no_image(screen: Chrome, console_url: str) -> None:
    page = opened_page(screen, console_url, "/nowhere")
    missing = screen.find_element(By.ID, "missing")
    page.wait_for(lambda: "/nowhere" in missing.text, "the message")
    assert images(screen) == []
    screen.find_element(By.PARTIAL_LINK_TEXT, NAMES[0]).click()
    page.wait_for(lambda: images(screen), "the image of the chosen one")
    assert not missing.is_displayed()


def chips(page: ConsolePage) -> list[str]:
    script = "return Array.from(arguments[0].querySelectorAll('.chip'), (chip) => chip.dataset.name)"
    return list(page.driver.execute_script(script, page.parameter("classes")))


def test_a_class_of_eighty_is_found_by_its_name(screen: Chrome, console_url: str) -> None:
    page = opened_page(screen, console_url, ACTIVE)
    page.wait_for(lambda: len(chips(page)) == len(CLASS_NAMES), "all classes")
    field = page.widget("classes", ".find")
    field.send_keys("SS 7")
    assert chips(page) == ["class 7", *(f"class 7{digit}" for digit in range(10))]
    page.wait_for_text('[data-parameter="classes"] .widget .hint', "11 of 80 found")
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys(Keys.DELETE)
    assert len(chips(page)) == len(CLASS_NAMES)


def test_selected_classes_come_first_once_the_keyboard_has_left(screen: Chrome, console_url: str) -> None:
    page = opened_page(screen, console_url, ACTIVE)
    page.wait_for(lambda: len(chips(page)) == len(CLASS_NAMES), "all classes")
    page.widget("classes", CHIP).click()
    page.wait_for(lambda: page.chosen("classes") == ["class 70"], "the chip")
    page.wait_for(lambda: not page.is_busy("classes"), "the answer")
    assert screen.switch_to.active_element.get_attribute("data-name") == "class 70"
    assert chips(page)[70] == "class 70"
    screen.execute_script("document.activeElement.blur()")
    page.wait_for(lambda: chips(page)[:2] == ["class 70", "class 0"], "the order")
    page.find(".undo button").click()
    page.wait_for(lambda: page.chosen("classes") == [], "no class")


@pytest.mark.parametrize("size_wh", [PHONE, (1400, 1000)], ids=["phone", "desktop"])
def test_the_classes_have_no_scroll_area_of_their_own(
    screen: Chrome, console_url: str, size_wh: tuple[int, int]
) -> None:
    set_screen(screen, size_wh, is_phone=size_wh == PHONE)
    page = opened_page(screen, console_url, ACTIVE)
    page.wait_for(lambda: len(chips(page)) == len(CLASS_NAMES), "all classes")
    areas = screen.execute_script(
        """
        const found = [];
        for (let part = arguments[0]; part; part = part.parentElement) {
          if (part.scrollHeight > part.clientHeight + 1 && getComputedStyle(part).overflowY !== "visible") {
            found.push(part.className);
          }
        }
        return found;
        """,
        page.widget("classes", CHIP),
    )
    assert areas == ([] if size_wh == PHONE else ["panel parameters"])


def test_foreign_text_is_text_wherever_it_is_shown(screen: Chrome, console_url: str) -> None:
    source = f"((...arguments) => {{{TAINT}}})({json.dumps(HOSTILE)})"
    screen.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": source})
    screen.get(f"{console_url}#{quote(HOSTILE, safe='')}")
    page = ConsolePage(screen, console_url)
    script = "return Array.from(document.querySelectorAll(arguments[0]), (part) => part.textContent).join()"

    def is_shown(css: str) -> bool:
        return HOSTILE in screen.execute_script(script, css)

    for css in PLACES:
        page.wait_for(partial(is_shown, css), f"the text in {css}")
    foreign = "img, iframe, script:not([src]), [onerror], [href^=javascript]"
    assert screen.find_elements(By.CSS_SELECTOR, foreign) == []
    assert screen.execute_script("return window.hit") is None
