"""Loading and freeing of models in a background thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future

from rclpy.node import Node

from yolov5_lifecycle.detection.prepared_model import Prepare, PreparedModel
from yolov5_lifecycle.ros.detector.background import Background
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import Settings

Preparation = Future[PreparedModel]
"""Once done, holds the model or the exception that explains the failure."""
REFUSALS = (ValueError, OSError, RuntimeError)
"""Exceptions of a preparation with a message for the user; any other is a bug."""


class ModelLoader:
    """Prepares one model at a time in its own thread, from construction to `close`.

    Models are warmed up with `sizes_hw(settings)`, the size of the last image of each camera in `settings`.
    `on_device_lost(reason)` is called when no further model can be prepared.
    """

    def __init__(
        self,
        node: Node,
        prepare: Prepare,
        *,
        sizes_hw: Callable[[Settings], Sequence[tuple[int, int]]],
        on_device_lost: Callable[[str], None],
    ) -> None:
        self._node = node
        self._prepare = prepare
        self._sizes_hw = sizes_hw
        self._on_device_lost = on_device_lost
        self._background = Background(node)

    def begin(self, settings: Settings) -> Preparation:
        """Queue the preparation of the model for `settings`."""
        sizes_hw = self._sizes_hw(settings)
        return self._background.submit(lambda: self._prepare(settings, sizes_hw))

    async def load(self, wanted: Callable[[], Settings | None]) -> Preparation | None:
        """Prepare the model for `wanted()`; repeat if other settings are wanted by then.

        Returns None as soon as `wanted()` does; models that are no longer wanted are freed.
        """
        while (settings := wanted()) is not None:
            preparation = await self._background.finish(self.begin(settings))
            error = preparation.exception()
            if isinstance(error, DeviceLostError):
                self._on_device_lost(str(error))
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
            self._node.get_logger().error(f"the previous model could not be freed: {error}")

    def close(self) -> bool:
        """Cancel queued work without waiting; return False if a model is still being loaded or freed."""
        return self._background.close()
