"""Long work beside the executor, awaited by its callbacks."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.task import Future as RosFuture

Result = TypeVar("Result")


class Background:
    """One thread that does work in the order it was given, while the executor of `node` answers others."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="background")
        self._unfinished: set[Future[Any]] = set()

    def submit(self, work: Callable[[], Result]) -> Future[Result]:
        """Queue `work`; the future has its result or exception."""
        future = self._thread.submit(work)
        self._unfinished.add(future)
        future.add_done_callback(self._unfinished.discard)
        return future

    async def finish(self, future: Future[Result]) -> Future[Result]:
        """Wait in a callback of the executor until `future` is done; returns it."""
        executor = self._node.executor
        assert executor is not None, "only a callback awaits, so there is an executor"
        done = RosFuture(executor=executor)

        def resume(_: object) -> None:
            done.set_result(None)
            # A result wakes nobody before rclpy 7.1.8 (ros2/rclpy#1374): the executor would sleep on.
            executor.wake()

        future.add_done_callback(resume)
        await done
        return future

    def close(self) -> bool:
        """Drop what has not begun; False when something runs, which goes on, unwaited for."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        return not self._unfinished
