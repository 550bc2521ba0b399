"""Models made and freed beside the executor."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import Future

from rclpy.node import Node

from yolov5_lifecycle.preparation import Prepare, PreparedModel
from yolov5_lifecycle.ros.background import Background
from yolov5_lifecycle.settings import Settings

Preparation = Future[PreparedModel]
"""A finished one has the model, or the exception that tells why there is none."""


class ModelLoader:
    """Prepares one model at a time in a thread of its own, from birth to `close`."""

    def __init__(self, node: Node, prepare: Prepare) -> None:
        self._prepare = prepare
        self._background = Background(node)

    def begin(self, settings: Settings) -> Preparation:
        """Queue the preparation of the model for `settings`."""
        return self._background.submit(functools.partial(self._prepare, settings))

    async def load(self, wanted: Callable[[], Settings | None]) -> Preparation | None:
        """The finished preparation of what `wanted()` asks for, and still asks for at the end.

        None as soon as `wanted()` says None; a model that nobody wants any more is freed.
        """
        while (settings := wanted()) is not None:
            preparation = await self._background.finish(self.begin(settings))
            if preparation.exception() is not None:
                return preparation
            now_wanted = wanted()
            if now_wanted is not None and preparation.result().serves(now_wanted):
                return preparation
            preparation.result().close()
        return None

    async def retire(self, model: PreparedModel, *, after: Callable[[], object]) -> None:
        """Call `after`, which waits for the frame that may still use `model`, then free it."""

        def free() -> None:
            after()
            model.close()

        await self._background.finish(self._background.submit(free))

    def close(self) -> bool:
        """Drop what has not begun; False when a model is being made or freed, which goes on, unwaited for."""
        return self._background.close()
