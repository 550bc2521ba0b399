"""Loading and freeing of models in a background thread, which callbacks of the executor await."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import KW_ONLY, dataclass
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.task import Future as RosFuture

from yolov5_lifecycle.detection.prepared_model import Prepare, PreparedModel
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import Settings

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


Preparation = Future[PreparedModel]
"""Once done, holds the model or the exception that explains the failure."""
REFUSALS = (ValueError, OSError, RuntimeError)
"""Exceptions of a preparation with a message for the user; any other is a bug."""


@dataclass(eq=False)
class ModelLoader:
    """Prepares one model at a time in its own thread, from construction to `close`.

    Models are warmed up with `sizes_hw(settings)`, the size of the last image of each camera in `settings`.
    `on_device_lost(reason)` is called when no further model can be prepared.
    """

    node: Node
    prepare: Prepare
    _: KW_ONLY
    sizes_hw: Callable[[Settings], Sequence[tuple[int, int]]]
    on_device_lost: Callable[[str], None]

    def __post_init__(self) -> None:
        self._background = Background(self.node)

    def begin(self, settings: Settings) -> Preparation:
        """Queue the preparation of the model for `settings`."""
        sizes_hw = self.sizes_hw(settings)
        return self._background.submit(lambda: self.prepare(settings, sizes_hw))

    async def load(self, wanted: Callable[[], Settings | None]) -> Preparation | None:
        """Prepare the model for `wanted()`; repeat if other settings are wanted by then.

        Returns None as soon as `wanted()` does; models that are no longer wanted are freed.
        """
        while (settings := wanted()) is not None:
            preparation = await self._background.finish(self.begin(settings))
            error = preparation.exception()
            if isinstance(error, DeviceLostError):
                self.on_device_lost(str(error))
            now_wanted = wanted()
            if now_wanted is not None and not settings.differing(now_wanted, Change.RELOAD):
                return preparation
            if error is None:
                preparation.result().close()
        return None

    async def retire(self, model: PreparedModel, *, after: Callable[[], bool]) -> None:
        """Free `model` after `after()`, which waits for its last frame and returns whether that finished."""
        freed = self._background.submit(lambda: model.close(is_at_rest=after()))
        if (error := (await self._background.finish(freed)).exception()) is not None:
            self.node.get_logger().error(f"the previous model could not be freed: {error}")

    def close(self) -> bool:
        """Cancel queued work without waiting; return False if a model is still being loaded or freed."""
        return self._background.close()
