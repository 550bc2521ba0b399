"""A place in the code under test at which a test can hold its threads."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

PATIENCE_S = 60.0


class Gate:
    """Holds every caller while it is closed; `reached` tells that one arrived since it was closed."""

    def __init__(self, *, is_open: bool = False) -> None:
        self.reached = threading.Event()
        self._is_open = threading.Event()
        self._turn = threading.Lock()
        if is_open:
            self.open()

    def close(self) -> None:
        with self._turn:
            self._is_open.clear()
            self.reached.clear()

    def open(self) -> None:
        self._is_open.set()

    def passed(self) -> None:
        """Called where the gate is."""
        with self._turn:
            self.reached.set()
            is_open = self._is_open.is_set()
        assert is_open or self._is_open.wait(PATIENCE_S)

    def before(self, run: Callable[..., Any]) -> Callable[..., Any]:
        """`run` with the gate before it."""

        def held(*arguments: Any, **options: Any) -> Any:
            self.passed()
            return run(*arguments, **options)

        return held

    def wait_until_reached(self) -> None:
        assert self.reached.wait(PATIENCE_S)
