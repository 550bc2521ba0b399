"""A place in the code under test at which a test can hold its threads."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

PATIENCE_S = 60.0
Result = TypeVar("Result")


class Gate:
    """Holds every caller while it is closed; `reached` tells that one arrived since it was closed."""

    def __init__(self, *, is_open: bool = False) -> None:
        self.reached = threading.Event()
        self._is_open = threading.Event()
        if is_open:
            self.open()

    def close(self) -> None:
        self._is_open.clear()
        self.reached.clear()

    def open(self) -> None:
        self._is_open.set()

    def passed(self) -> None:
        """Called where the gate is."""
        self.reached.set()
        assert self._is_open.wait(PATIENCE_S)

    def before(self, run: Callable[[], Result]) -> Callable[[], Result]:
        """`run` with the gate before it."""

        def held() -> Result:
            self.passed()
            return run()

        return held

    def wait_until_reached(self) -> None:
        assert self.reached.wait(PATIENCE_S)
