"""Cameras, publishers and model, which transitions create and release, and the threads behind them."""

from __future__ import annotations

import itertools
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractContextManager, asynccontextmanager

from rclpy.lifecycle import LifecycleNode, LifecyclePublisher

from yolov5_lifecycle.detection.prepared_model import Prepare
from yolov5_lifecycle.process.memory import resident_mb
from yolov5_lifecycle.ros.detector.background import Background
from yolov5_lifecycle.ros.detector.collect_service import CollectService
from yolov5_lifecycle.ros.detector.detector_camera import DetectorCamera
from yolov5_lifecycle.ros.detector.frame_failures import FrameFailures
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.model_loader import ModelLoader, Preparation
from yolov5_lifecycle.ros.detector.outputs import label_info_publisher
from yolov5_lifecycle.ros.detector.pipeline import DetectedFrame
from yolov5_lifecycle.ros.detector.session import Session
from yolov5_lifecycle.ros.detector.status import Status
from yolov5_lifecycle.ros.namesakes import namesakes
from yolov5_lifecycle.ros.parameters.settings_parameters import SettingsParameters
from yolov5_lifecycle.ros.topics import impossible_names
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.worker import Worker


class ManagedResources:
    """Owns the cameras, their publishers from `configure` to `release`, and the session from `activate` to
    `deactivate`.

    The inference thread and the model loader exist from construction to `close`. `on_too_many(reason)`, whose
    result is awaited, and `on_device_lost(reason)` are called in the executor; see `FrameFailures`.
    A frame in progress is waited for `rest_timeout_s`.
    """

    def __init__(
        self,
        node: LifecycleNode,
        *,
        parameters: SettingsParameters,
        prepare: Prepare,
        on_too_many: Callable[[str], Awaitable[None]],
        on_device_lost: Callable[[str], None],
        rest_timeout_s: float,
    ) -> None:
        self._node = node
        self._rest_timeout_s = rest_timeout_s
        self._parameters = parameters
        self._failures = FrameFailures(
            node,
            max_consecutive=lambda: parameters.value("max_consecutive_failures"),
            on_too_many=on_too_many,
            on_device_lost=on_device_lost,
        )
        self._worker: Worker[ReceivedFrame, DetectedFrame] = Worker()
        self._track_ids = itertools.count(1)
        self._waits = Background(node, "waits")
        self._cameras: dict[str, DetectorCamera] = {}
        self._collecting = CollectService(node, parameters, self._cameras)
        self.loader = ModelLoader(node, prepare, sizes_hw=self._sizes_hw, on_device_lost=on_device_lost)
        self.session: Session | None = None
        self._label_info: LifecyclePublisher | None = None
        self._loading_for: LifecyclePublisher | None = None

    def configure(self) -> None:
        """Create the publishers; raises rclpy's exception."""
        self._label_info = label_info_publisher(self._node)
        self._make_cameras()
        for camera in self._cameras.values():
            camera.configure()

    async def load(self) -> bool:
        """Load the model while other callbacks are served; False if another transition was requested first.

        Then `detection` exists, and `activate` starts it or raises what loading raised.
        """
        label_info = self._label_info
        if self._loading_for is label_info:
            self._node.get_logger().warning("activate refused: the model is already being loaded")
            return False
        self._loading_for = label_info
        preparation = await self.loader.load(
            lambda: self._parameters.settings() if self._may_activate(label_info) else None
        )
        if self._loading_for is label_info:
            self._loading_for = None
        if preparation is None or label_info is None:
            self._node.get_logger().warning(
                "activate canceled because another transition arrived while the model was loading"
            )
            return False
        self.session = self._new_session(label_info, preparation)
        return True

    def activate(self) -> Session:
        """Start the loaded detection; if a program triggered the transition without `load`, load now.

        Raises what loading the model raises, and SettingsError if the settings do not fit it.
        """
        assert self._label_info is not None, "rclpy activates only a configured node"
        settings = self._parameters.settings()
        if self.session is None:
            self.session = self._new_session(self._label_info, self.loader.begin(settings))
        self.session.start(settings)
        self._failures.restart()
        return self.session

    @asynccontextmanager
    async def between_frames(self) -> AsyncIterator[None]:
        """In the block no frame is in progress, of any camera, unless one hangs; others are served before."""
        with self._worker.paused():
            await self.rest()
            yield

    def paused(self) -> AbstractContextManager[None]:
        """In the block no frame begins."""
        return self._worker.paused()

    async def rest(self) -> None:
        """Wait until the frame in progress, if any, has ended or hangs, while other callbacks are served."""
        if not self._worker.is_at_rest():
            await self._waited(self._worker.rest)

    async def _waited(self, rest: Callable[[float], bool]) -> None:
        """Call `rest(timeout_s)` in a thread: the executor itself never waits for a frame."""
        await self._waits.finish(self._waits.submit(lambda: rest(self._rest_timeout_s)))

    def deactivate(self) -> bool:
        """Release the detection; False if its frame hangs and the thread was abandoned.

        Call it `paused` and after `rest`: otherwise it waits for the frame in progress itself.
        """
        session, self.session = self.session, None
        return session is None or session.close()

    def release(self) -> None:
        """Destroy the publishers; call after `deactivate`."""
        for camera in self._cameras.values():
            camera.release()
        if self._label_info is not None:
            # destroy_publisher would leave it in the list of managed entities.
            self._node.destroy_lifecycle_publisher(self._label_info)
            self._label_info = None

    def close(self) -> None:
        """End the threads; those that hang are abandoned and logged."""
        log = self._node.get_logger()
        if not self.loader.close():
            log.warning("a model is still being loaded or freed: its thread is abandoned")
        if not self._worker.close(self._rest_timeout_s):
            log.warning("inference has still not finished: its thread is abandoned")
        self._collecting.close()
        self._waits.close()

    def abandoned_threads(self) -> int:
        """Number of inference threads that hung and have not ended yet."""
        return self._worker.abandoned_threads()

    def status(self, state: str, problem: str) -> Status:
        """Snapshot of the node in the lifecycle state `state`, with the last `problem` that was reported."""
        if self._label_info is None and not impossible_names(self._node, self._names()):
            self._make_cameras()  # `configure` refuses impossible names
        return Status(
            state=state,
            problem=problem,
            settings=self._parameters.settings() if self._label_info else None,
            model=self.session.model if self.session else None,
            cameras=tuple(
                camera.status(self._parameters.value_for(name, "image_transport"))
                for name, camera in self._cameras.items()
            ),
            abandoned_threads=self._worker.abandoned_threads(),
            resident_mb=resident_mb(),
            collected=self._collecting.status,
            namesakes=namesakes(self._node),
        )

    def _sizes_hw(self, settings: Settings) -> list[tuple[int, int]]:
        """The size of each camera's last image, or a common size."""
        return [self._cameras[name].last_image.size_hw for name in settings.camera_names]

    def _make_cameras(self) -> None:
        """Those that the parameters name; the others, of which no frame is in progress, end."""
        names = self._names()
        for name in [name for name in self._cameras if name not in names]:
            self._cameras.pop(name).close()
        for name in names:
            if name not in self._cameras:
                self._cameras[name] = self._new_camera(name)

    def _names(self) -> tuple[str, ...]:
        """The cameras that the parameters name; valid even if other settings are not."""
        return self._parameters.value("cameras") or ("",)

    def _new_camera(self, name: str) -> DetectorCamera:
        return DetectorCamera(
            self._node,
            name,
            names=self._names,
            worker=self._worker,
            failures=self._failures,
            track_ids=self._track_ids,
            collector=self._collecting.collector,
        )

    def _may_activate(self, label_info: LifecyclePublisher | None) -> bool:
        """Whether the configuration with `label_info` still exists and is not active."""
        return self._label_info is label_info and self.session is None

    def _new_session(self, label_info: LifecyclePublisher, preparation: Preparation) -> Session:
        return Session(
            self._node,
            preparation=preparation,
            cameras=self._cameras,
            rest_timeout_s=self._rest_timeout_s,
            label_info=label_info,
            worker=self._worker,
        )
