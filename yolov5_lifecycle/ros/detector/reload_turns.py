"""Queue for concurrent model reloads."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.task import Future

from yolov5_lifecycle.ros.detector.background import resume


class ReloadTurns:
    """Lets one reload run and one wait; a later request supersedes the waiting one.

    Otherwise every queued reload would load a model that the next one replaces.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._is_running = False
        self._waiting: Future | None = None

    async def begin(self) -> bool:
        """Wait until no other reload runs; return False if a later request superseded this one."""
        if not self._is_running:
            self._is_running = True
            return True
        if self._waiting is not None:
            self._resume(self._waiting, False)
        turn = self._waiting = Future(executor=self._node.executor)
        return bool(await turn)

    def end(self) -> None:
        """Let the waiting reload begin; call once after each `begin` that returned True."""
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            self._is_running = False
        else:
            self._resume(waiting, True)

    def _resume(self, turn: Future, may_begin: bool) -> None:
        if (executor := self._node.executor) is not None:
            resume(turn, may_begin, executor)
