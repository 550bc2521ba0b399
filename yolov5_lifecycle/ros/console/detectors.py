"""All detectors of the ROS graph that the console shows."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from contextlib import suppress

from rclpy.exceptions import NameValidationException

from yolov5_lifecycle.ros.console.broadcasts import Broadcasts
from yolov5_lifecycle.ros.console.camera_view import StatusView
from yolov5_lifecycle.ros.console.detector import Detector
from yolov5_lifecycle.ros.console.detector_link import DetectorLink
from yolov5_lifecycle.ros.console.graph import Candidate, candidates
from yolov5_lifecycle.ros.console.log_view import LogLine, Logs, logger_name
from yolov5_lifecycle.ros.console.ros_thread import RosThread

SCAN_S = 1.0
MAX_DETECTORS = 32
TRIAL_S = 10.0
"""A node that does not answer as a detector for so long makes room for others that may be detectors."""


class Detectors:
    """Finds detectors and keeps them up to date; `names`: full names of the wanted ones, empty: all.

    `on_change(detector)` is called after each change of a known one, `on_gone(detector)` when one has left
    the graph or is silent, `on_omitted(names)` when others are left out because there are too many.
    """

    def __init__(
        self,
        ros: RosThread,
        names: tuple[str, ...],
        *,
        on_change: Callable[[Detector], object],
        on_gone: Callable[[Detector], object],
        on_omitted: Callable[[list[str]], object],
    ) -> None:
        self._ros = ros
        self._names = names
        self._on_change = on_change
        self._on_gone = on_gone
        self._on_omitted = on_omitted
        self._candidates: dict[str, Candidate] = {}
        self._sent_diagnostics: set[str] = set()
        self._is_new = asyncio.Event()
        self._followed: dict[str, Detector] = {}
        self._followed_s: dict[str, float] = {}
        """When a candidate was followed last."""
        self._shown: set[str] = set()
        self._omitted: list[str] = []
        self._unconfirmed: set[str] = set()  # hidden until a scan tells whether they were restarted
        self._by_logger: dict[str, str] = {}
        self._logs = Logs(self._by_logger.__contains__)
        self._broadcasts = Broadcasts(
            ros,
            lambda name: name in self._candidates,
            on_parameters=self._take_hint,
            on_diagnostics=self._take_diagnostics,
            on_log=self._take_log,
        )
        self._task: asyncio.Task[None] | None = None

    async def open(self) -> None:
        await self._broadcasts.open()
        self._task = asyncio.create_task(self._follow())

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task

    @property
    def known(self) -> list[Detector]:
        """Those that are shown, by name."""
        return [self._followed[name] for name in sorted(self._shown)]

    def find(self, name: object) -> Detector | None:
        """The detector called `name`, if it is shown."""
        return self._followed[name] if isinstance(name, str) and name in self._shown else None

    async def _follow(self) -> None:
        while True:
            were_silent = (self._followed[name] for name in self._unconfirmed)
            returned = [detector for detector in were_silent if not detector.is_silent]
            found = await self._ros.run(candidates, self._ros.node, self._names)
            self._candidates = {candidate.name: candidate for candidate in found}
            await self._update()
            self._show_again(returned)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._is_new.wait(), SCAN_S)
            self._is_new.clear()

    async def _update(self) -> None:
        """Adapt those that are followed to the candidates."""
        present = self._candidates
        self._sent_diagnostics &= present.keys()
        for name in self._followed_s.keys() - present.keys():
            del self._followed_s[name]
        for name, detector in list(self._followed.items()):
            if name not in present or present[name].publishers - detector.publishers:
                self._followed_s.pop(name, None)  # restarted, it comes before others
                await self._forget(detector)
            elif detector.is_silent and name in self._shown:
                self._hide(detector)
                detector.invalidate()
                self._unconfirmed.add(name)
        waiting = self._waiting
        await self._make_room(len(waiting))
        room = MAX_DETECTORS - len(self._followed)
        for name in waiting[:room]:
            await self._begin(present[name])
        self._omit(waiting[room:])

    @property
    def _waiting(self) -> list[str]:
        """Candidates that send diagnostics as a detector does and are not followed, the next one first."""
        names = self._sent_diagnostics - self._followed.keys()
        return sorted(names, key=lambda name: (self._followed_s.get(name, 0.0), name))

    async def _make_room(self, wanted: int) -> None:
        """Give up at most `wanted` nodes that have not answered as a detector in their time."""
        now_s = time.monotonic()
        for name, detector in list(self._followed.items()):
            is_over = now_s - self._followed_s[name] > TRIAL_S
            is_useless = is_over and name not in self._shown | self._unconfirmed
            if is_useless and len(self._followed) + wanted > MAX_DETECTORS:
                await self._forget(detector)

    async def _begin(self, candidate: Candidate) -> None:
        name = candidate.name
        self._by_logger[logger_name(name)] = name
        self._followed_s[name] = time.monotonic()
        log = self._logs.of(logger_name(name))
        link = DetectorLink(self._ros, name)
        detector = Detector(link, candidate.publishers, on_change=self._changed, log=log)
        self._followed[name] = detector
        try:
            await detector.open()
        except NameValidationException as error:
            self._ros.node.get_logger().warning(f"{name} cannot be shown: {error}")
            await self._forget(detector)

    def _omit(self, names: list[str]) -> None:
        if names != self._omitted:
            self._omitted = names
            self._on_omitted(names)

    def _show_again(self, returned: Iterable[Detector]) -> None:
        """Show those whose process is still the one that was silent; the others have been forgotten."""
        for detector in returned:
            if self._followed.get(detector.name) is detector:
                self._unconfirmed.discard(detector.name)
                self._changed(detector)

    async def _forget(self, detector: Detector) -> None:
        self._hide(detector)
        self._unconfirmed.discard(detector.name)
        del self._followed[detector.name]
        del self._by_logger[logger_name(detector.name)]
        await detector.close()

    def _hide(self, detector: Detector) -> None:
        if detector.name in self._shown:
            self._shown.remove(detector.name)
            self._on_gone(detector)

    def _changed(self, detector: Detector) -> None:
        is_current = self._followed.get(detector.name) is detector and detector.name not in self._unconfirmed
        if not is_current or not detector.is_known or detector.is_silent:
            return
        self._shown.add(detector.name)
        self._on_change(detector)

    def _take_hint(self, name: str) -> None:
        if name in self._followed:
            self._followed[name].want_parameters()

    def _take_diagnostics(self, name: str, statuses: list[StatusView]) -> None:
        if name not in self._sent_diagnostics:
            self._sent_diagnostics.add(name)
            self._is_new.set()
        if name in self._followed:
            self._followed[name].take_diagnostics(statuses)

    def _take_log(self, logger: str, line: LogLine) -> None:
        self._logs.of(logger).add(line)
        if name := self._by_logger.get(logger):
            self._changed(self._followed[name])
