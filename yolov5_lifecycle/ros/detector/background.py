"""Threads for what executor callbacks await, and the order of concurrent reloads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.task import Future as RosFuture

Result = TypeVar("Result")


def resume(waiting: RosFuture, result: object, executor: Executor) -> None:
    """Resume the callback that awaits `waiting`, with `result`."""
    waiting.set_result(result)
    # Before rclpy 7.1.8, set_result does not wake the executor (ros2/rclpy#1374).
    executor.wake()


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
        executor = self._node.executor
        assert executor is not None, "only a callback awaits, so there is an executor"
        done = RosFuture(executor=executor)

        future.add_done_callback(lambda _: resume(done, None, executor))
        await done
        return future

    def close(self) -> bool:
        """Cancel queued tasks without waiting; return False if one is still running and continues."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        return not self._unfinished


class ReloadTurns:
    """Lets one reload run and one wait; a later request supersedes the waiting one.

    Otherwise every queued reload would load a model that the next one replaces.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._is_running = False
        self._waiting: RosFuture | None = None

    async def begin(self) -> bool:
        """Wait until no other reload runs; return False if a later request superseded this one."""
        if not self._is_running:
            self._is_running = True
            return True
        if self._waiting is not None:
            self._resume(self._waiting, False)
        turn = self._waiting = RosFuture(executor=self._node.executor)
        return bool(await turn)

    def end(self) -> None:
        """Let the waiting reload start; call once after each `begin` that returned True."""
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            self._is_running = False
        else:
            self._resume(waiting, True)

    def _resume(self, turn: RosFuture, may_begin: bool) -> None:
        if (executor := self._node.executor) is not None:
            resume(turn, may_begin, executor)
