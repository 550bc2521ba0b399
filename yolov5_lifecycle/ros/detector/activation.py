"""Loading of the model before the `activate` transition runs."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from yolov5_lifecycle.ros.detector.model_loader import ModelLoader, Preparation
from yolov5_lifecycle.settings.settings import Settings


class ActivationModel:
    """Loads the model while other callbacks are served, then hands it to the transition.

    `configuration()` returns an object that every configure recreates, None while unconfigured; `settings()`
    returns its settings.
    """

    def __init__(
        self,
        node: Node,
        loader: ModelLoader,
        *,
        configuration: Callable[[], object],
        settings: Callable[[], Settings | None],
    ) -> None:
        self._node = node
        self._loader = loader
        self._configuration = configuration
        self._settings = settings
        self._loading_for: object = None
        self._loaded: Preparation | None = None

    async def load(self) -> bool:
        """Load the model of the current configuration; return False if another transition came first."""
        configuration = self._configuration()
        if self._loading_for is configuration:
            self._node.get_logger().warning("activate refused: the model is being loaded already")
            return False
        self._loading_for = configuration
        loaded = await self._loader.load(
            lambda: self._settings() if self._configuration() is configuration else None
        )
        if self._loading_for is configuration:
            self._loading_for = None
        if loaded is None:
            self._node.get_logger().warning(
                "activate canceled: another transition came while the model was loading"
            )
            return False
        self._loaded = loaded
        return True

    def take(self, settings: Settings) -> Preparation:
        """Return what `load` loaded; without it (activated in-process by a program), start loading now."""
        loaded, self._loaded = self._loaded, None
        return loaded or self._loader.begin(settings)
