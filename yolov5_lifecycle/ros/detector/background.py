"""Work in background threads, which callbacks of the executor await."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.task import Future as RosFuture

Result = TypeVar("Result")


def resume(node: Node, waiting: RosFuture, result: object = None) -> None:
    """Resume the callback of `node` that awaits `waiting`, with `result`."""
    waiting.set_result(result)
    if (executor := node.executor) is not None:
        executor.wake()  # before rclpy 7.1.8, set_result does not (ros2/rclpy#1374)


class Background:
    """One thread, called `name`, that runs tasks in FIFO order while the executor of `node` keeps serving
    callbacks.
    """

    def __init__(self, node: Node, name: str = "background") -> None:
        self._node = node
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
        # The pool starts its thread with the first task; later the node's number of threads stays constant.
        self._thread.submit(lambda: None)
        self._unfinished: set[Future[Any]] = set()

    def submit(self, work: Callable[[], Result]) -> Future[Result]:
        """Queue `work`; the future receives its result or exception."""
        future = self._thread.submit(work)
        self._unfinished.add(future)
        future.add_done_callback(self._unfinished.discard)
        return future

    async def finish(self, future: Future[Result]) -> Future[Result]:
        """Await `future` inside an executor callback, then return it."""
        done = RosFuture(executor=self._node.executor)
        future.add_done_callback(lambda _: resume(self._node, done))
        await done
        return future

    def close(self) -> bool:
        """Cancel queued tasks without waiting; return False if one is still running and continues."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        return not self._unfinished
