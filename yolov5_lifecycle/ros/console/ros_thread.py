"""The thread that spins the console's node, and the hand-over between it and the event loop."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from yolov5_lifecycle.ros.spin import spin

Result = TypeVar("Result")
_END_S = 1.0
"""Max wait for the callback in progress at the end."""


class NotReachedError(Exception):
    """A service did not answer in time, does not exist, or its node is lost."""


class RosThread:
    """Spins `node` in its own thread, the only one that uses ROS.

    The methods are called in the thread of the event loop `loop`, except `post`. What they run and send
    keeps its order.
    """

    def __init__(self, node: Node, loop: asyncio.AbstractEventLoop) -> None:
        self.node = node
        self._loop = loop
        self._is_stopping = threading.Event()
        self._jobs: deque[Callable[[], None]] = deque()
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, name="ros", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> bool:
        """End the thread; return whether it has ended and the node may be destroyed."""
        self._is_stopping.set()
        self._executor.wake()
        self._thread.join(_END_S)
        if self._thread.is_alive():
            return False
        self._executor.shutdown()  # else the garbage collector does, and raises if it takes its parts first
        return True

    def post(self, function: Callable[..., object], *arguments: object) -> None:
        """Call `function` soon in the thread of the event loop; may be called in any thread."""
        with suppress(RuntimeError):  # the loop has been closed
            self._loop.call_soon_threadsafe(function, *arguments)

    def run(self, function: Callable[..., Result], *arguments: object) -> asyncio.Future[Result]:
        """Call `function` soon in the thread of ROS; the future has its result or exception."""
        answer: asyncio.Future[Result] = self._loop.create_future()

        def job() -> None:
            try:
                result = function(*arguments)
            except Exception as error:  # noqa: BLE001 - raised where the future is awaited
                self.post(_fail, answer, error)
            else:
                self.post(_resolve, answer, result)

        self._jobs.append(job)
        self._executor.create_task(self._work)
        return answer

    async def call(self, client: Any, request: Any, *, timeout_s: float, end: asyncio.Future[None]) -> Any:
        """The response of the service of `client`; raises NotReachedError, at the latest at `end`."""
        answer: asyncio.Future[Any] = self._loop.create_future()

        def send() -> Any:
            if not client.service_is_ready():
                raise NotReachedError(f"service {client.srv_name} not found")
            future = client.call_async(request)
            future.add_done_callback(lambda done: self.post(_resolve, answer, done.result()))
            return future

        pending = await self.run(send)
        try:
            await asyncio.wait((answer, end), timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            if answer.done():
                return answer.result()
            if end.done():
                raise NotReachedError(f"{client.srv_name} was lost before it answered")
            raise NotReachedError(f"{client.srv_name} did not answer within {timeout_s:g} s")
        finally:
            self.run(client.remove_pending_request, pending).add_done_callback(_observed)

    def _work(self) -> None:
        # rclpy runs tasks in any order; a later change of a parameter must not overtake an earlier one.
        self._jobs.popleft()()

    def _spin(self) -> None:
        spin(self._executor, self.node, until=self._is_stopping.is_set)


class Hint:
    """Calls `take()` soon in the thread of the event loop; once, however often it is called until then."""

    def __init__(self, ros: RosThread, take: Callable[[], object]) -> None:
        self._ros = ros
        self._take = take
        self._is_given = False

    def __call__(self, *_: object) -> None:
        """May be called in any thread, such as by a subscription with its message."""
        if not self._is_given:
            self._is_given = True
            self._ros.post(self._answer)

    def _answer(self) -> None:
        self._is_given = False
        self._take()


def _resolve(future: asyncio.Future[Any], result: object) -> None:
    if not future.done():
        future.set_result(result)


def _fail(future: asyncio.Future[Any], error: Exception) -> None:
    if not future.done():
        future.set_exception(error)


def _observed(future: asyncio.Future[Any]) -> None:
    """Retrieve the outcome, as nobody else does, so that asyncio does not report it."""
    if not future.cancelled():
        future.exception()
