"""The thread that spins the console's node, and the hand-over between it and the event loop."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, Generic, TypeVar

from rclpy.node import Node

from yolov5_lifecycle.ros.nodes import spin
from yolov5_lifecycle.ros.rclpy_internals import ResilientExecutor

Item = TypeVar("Item")
Result = TypeVar("Result")
_END_S = 1.0
"""Max wait for the callback in progress at the end."""


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
        self._executor = ResilientExecutor(context=node.context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, name="ros", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread, unless it hangs."""
        self._is_stopping.set()
        self._executor.wake()
        self._thread.join(_END_S)
        if not self._thread.is_alive():
            # Else the garbage collector does, and raises if it takes its parts first.
            self._executor.shutdown()

    def post(self, function: Callable[..., object], *arguments: object) -> None:
        """Call `function` soon in the thread of the event loop; may be called in any thread."""
        with suppress(RuntimeError):  # the loop has been closed
            self._loop.call_soon_threadsafe(function, *arguments)

    def run(self, function: Callable[..., Result], *arguments: object) -> asyncio.Future[Result]:
        """Call `function` soon in the thread of ROS; the future has its result or exception."""
        answer: Future[Result] = Future()

        def job() -> None:
            if answer.set_running_or_notify_cancel():
                try:
                    answer.set_result(function(*arguments))
                except Exception as error:  # noqa: BLE001 - raised where the future is awaited
                    answer.set_exception(error)

        self._jobs.append(job)
        # rclpy runs tasks in any order; a later change of a parameter must not overtake an earlier one.
        self._executor.create_task(lambda: self._jobs.popleft()())
        return asyncio.wrap_future(answer, loop=self._loop)

    async def call(self, client: Any, request: Any, *, timeout_s: float, end: asyncio.Future[None]) -> Any:
        """The response of the service of `client`.

        Raises ConnectionError if it does not exist or answers neither within `timeout_s` nor before `end`.
        """
        answer: Future[Any] = Future()

        def send() -> Any:
            if not client.service_is_ready():
                raise ConnectionError(f"service {client.srv_name} not found")
            future = client.call_async(request)
            future.add_done_callback(lambda done: answer.set_result(done.result()))
            return future

        pending = await self.run(send)
        answered = asyncio.wrap_future(answer, loop=self._loop)
        try:
            await asyncio.wait((answered, end), timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            if answered.done():
                return answered.result()
            if end.done():
                later = "it may have done what was asked: look again once the detector is back"
                raise ConnectionError(f"{client.srv_name} was lost before it answered; {later}")
            raise ConnectionError(f"{client.srv_name} did not answer within {timeout_s:g} s")
        finally:
            self.run(client.remove_pending_request, pending)

    def _spin(self) -> None:
        spin(self._executor, self.node, until=self._is_stopping.is_set)


class Mailbox(Generic[Item]):
    """Hands what is put in to `take(item)`, soon in the thread of the event loop; keeps the newest `size`."""

    def __init__(self, ros: RosThread, take: Callable[[Item], object], *, size: int = 1) -> None:
        self._ros = ros
        self._take = take
        self._items: deque[Item] = deque(maxlen=size)
        self._is_announced = False

    def put(self, item: Item) -> None:
        """May be called in the thread of ROS, such as by a subscription with its message."""
        self._items.append(item)
        if not self._is_announced:
            self._is_announced = True
            self._ros.post(self._empty)

    def _empty(self) -> None:
        self._is_announced = False  # first, so that an item that comes now is announced
        for _ in range(len(self._items)):
            self._take(self._items.popleft())
