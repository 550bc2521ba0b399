"""The page of the console in a browser, as a person sees and uses it."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from selenium.common.exceptions import NoSuchElementException, StaleElementReferenceException
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

from support.detector_process import NODE

PATIENCE_S = 60.0
_POLL_S = 0.05

Result = TypeVar("Result")


class ConsolePage:
    """The page that the browser shows; what is looked for is that of the detector `node`."""

    def __init__(self, driver: Chrome, node: str = NODE) -> None:
        self.driver = driver
        self._node = f'article[data-node="{node}"]'

    def wait_for(self, condition: Callable[[], Result], what: str) -> Result:
        """Wait until `condition()` is true, and return it."""
        missing = (NoSuchElementException, StaleElementReferenceException)
        wait = WebDriverWait(self.driver, PATIENCE_S, _POLL_S, missing)
        return wait.until(lambda _: condition(), f"waiting for {what}")

    def find(self, css: str) -> WebElement:
        """The first element of the detector's part that `css` selects."""
        return self.driver.find_element(By.CSS_SELECTOR, f"{self._node} {css}")

    def find_all(self, css: str) -> list[WebElement]:
        return self.driver.find_elements(By.CSS_SELECTOR, f"{self._node} {css}")

    def text(self, css: str) -> str:
        """What is visible of it."""
        return self.find(css).text

    def wait_for_text(self, css: str, words: str) -> str:
        """Wait until the visible text contains `words`, and return it."""
        self.wait_for(lambda: words in self.text(css), f"'{words}' in {css}")
        return self.text(css)

    @property
    def state(self) -> str:
        """The lifecycle state shown, "" while the detector is not."""
        states = self.find_all(".state")
        return states[0].text if states else ""

    def wait_for_state(self, state: str) -> None:
        self.wait_for(lambda: self.state == state, f"the state {state}")

    def condition(self) -> tuple[list[str], str]:
        """The condition and its word in the summary, and the text of the tab; the colour of its symbol."""
        script = """
            const [reason, tab] = [arguments[0], document.querySelector("nav a[aria-current]")];
            const word = reason.querySelector(".level").textContent;
            const { color } = getComputedStyle(tab.querySelector(".symbol"));
            return [[reason.dataset.condition, word, tab.textContent], color];
            """
        shown, colour = self.driver.execute_script(script, self.find(".reason"))
        return list(shown), str(colour)

    def press(self, transition: str) -> None:
        """Press the button of a transition once it is there."""
        css = f'[data-transition="{transition}"]'
        self.wait_for(lambda: self.find(css).is_displayed(), f"the button {transition}")
        self._scroll_to(self.find(css))
        self.find(css).click()

    def parameter(self, name: str) -> WebElement:
        """The part of a parameter, once there is one, its group opened and scrolled to."""
        part = self.wait_for(lambda: self.find(f'[data-parameter="{name}"]'), f"the parameter {name}")
        if not part.is_displayed():
            summary = part.find_element(By.XPATH, "./ancestor::details/summary")
            self._scroll_to(summary)
            summary.click()
        self._scroll_to(part)
        return part

    def widget(self, name: str, css: str) -> WebElement:
        """What of the parameter's part `css` selects."""
        return self.parameter(name).find_element(By.CSS_SELECTOR, css)

    def is_busy(self, name: str) -> bool:
        """Whether the parameter waits for the answer to a change."""
        return self.parameter(name).get_attribute("aria-busy") == "true"

    def refusal(self, name: str) -> str:
        """The reason shown at the parameter once there is one."""
        css = f'[data-parameter="{name}"] .refusal'
        return self.wait_for(lambda: self.text(css), f"a refusal of {name}")

    def enter(self, name: str, text: str) -> None:
        """Type a new value into the parameter's text field."""
        field = self.widget(name, 'input[type="text"]')
        field.send_keys(Keys.CONTROL, "a")
        field.send_keys(text, Keys.ENTER)

    def reset(self, name: str) -> None:
        """Press the button that sets a parameter to its default, once the page shows that it differs."""
        button = self.widget(name, ".reset")
        self.wait_for(button.is_displayed, f"the button that resets {name}")
        button.click()

    def chosen(self, name: str) -> list[str]:
        """The chips of the parameter that are pressed."""
        chips = self.parameter(name).find_elements(By.CSS_SELECTOR, '.chip[aria-pressed="true"]')
        return [chip.get_attribute("data-name") or "" for chip in chips]

    def stamp_s(self, camera: str = "") -> float:
        """Stamp of the image that is shown, 0 before the first."""
        stamp = self._canvas(camera).get_attribute("data-stamp-s")
        return float(stamp) if stamp else 0.0

    def wait_for_image(self, camera: str = "") -> None:
        """Wait until a newer image is shown."""
        shown_s = self.stamp_s(camera)
        self.wait_for(lambda: self.stamp_s(camera) > shown_s, "a newer image")

    def image(self, camera: str = "") -> tuple[float, NDArray[np.uint8]]:
        """Stamp and BGR pixels (H, W, 3) of the image that is shown."""
        script = "return [Number(arguments[0].dataset.stampS), arguments[0].toDataURL('image/png')]"
        stamp_s, url = self.driver.execute_script(script, self._canvas(camera))
        content = base64.b64decode(url.partition(",")[2])
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        return float(stamp_s), np.asarray(pixels, np.uint8)

    def _scroll_to(self, part: WebElement) -> None:
        """Bring it to the middle: at the top, the bar may lie above it."""
        self.driver.execute_script("arguments[0].scrollIntoView({ block: 'center' })", part)

    def _canvas(self, camera: str) -> WebElement:
        return self.find(f'[data-camera="{camera}"] canvas')
