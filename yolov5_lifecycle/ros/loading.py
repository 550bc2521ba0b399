"""Models made and freed beside the executor."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

from rclpy.node import Node

from yolov5_lifecycle.preparation import Prepare, PreparedModel
from yolov5_lifecycle.ros.background import Background
from yolov5_lifecycle.ros.last_picture import LastPicture
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.setting import Change
from yolov5_lifecycle.settings import Settings

Preparation = Future[PreparedModel]
"""A finished one has the model, or the exception that tells why there is none."""
REFUSALS = (ValueError, OSError, RuntimeError)
"""What a preparation raises with a message for the user; anything else is a mistake of ours."""


class ModelLoader:
    """Prepares one model at a time in a thread of its own, from birth to `close`.

    It is warmed up for pictures like the last one. `on_device_lost(reason)` is called when no further model
    can be prepared.
    """

    def __init__(
        self,
        node: Node,
        prepare: Prepare,
        *,
        last_picture: LastPicture,
        on_device_lost: Callable[[str], None],
    ) -> None:
        self._node = node
        self._prepare = prepare
        self._last_picture = last_picture
        self._on_device_lost = on_device_lost
        self._background = Background(node)

    def begin(self, settings: Settings) -> Preparation:
        """Queue the preparation of the model for `settings`."""
        return self._background.submit(lambda: self._prepare(settings, self._last_picture.size_hw))

    async def load(self, wanted: Callable[[], Settings | None]) -> Preparation | None:
        """The finished preparation of what `wanted()` asks for, and still asks for at the end.

        None as soon as `wanted()` says None; a model that nobody wants any more is freed.
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
        """Free `model` after `after`, which waits for its last frame and says whether that ended."""
        freed = self._background.submit(lambda: model.close(is_at_rest=after()))
        if (error := (await self._background.finish(freed)).exception()) is not None:
            self._node.get_logger().error(f"the replaced model could not be freed: {error}")

    def close(self) -> bool:
        """Drop what has not begun; False when a model is being made or freed, which goes on, unwaited for."""
        return self._background.close()
