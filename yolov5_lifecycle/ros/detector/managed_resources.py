"""Cameras, publishers and model, which transitions create and release, and the threads behind them."""

from __future__ import annotations

import itertools
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractContextManager, asynccontextmanager

from rclpy.lifecycle import LifecycleNode, LifecyclePublisher

from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW
from yolov5_lifecycle.detection.prepared_model import Prepare, most_lanes
from yolov5_lifecycle.process.memory import resident_mb
from yolov5_lifecycle.ros.detector.background import Background
from yolov5_lifecycle.ros.detector.collect_service import CollectService
from yolov5_lifecycle.ros.detector.detector_camera import DetectorCamera
from yolov5_lifecycle.ros.detector.frame_failures import FrameFailures
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.model_loader import ModelLoader, Preparation
from yolov5_lifecycle.ros.detector.outputs import label_info_publisher
from yolov5_lifecycle.ros.detector.pipeline import DetectedFrame
from yolov5_lifecycle.ros.detector.session import Session, abandoned
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
    `on_abandoned()` is called when the thread of a removed camera hangs: if a frame in progress has not ended
    after `rest_timeout_s`.
    """

    def __init__(
        self,
        node: LifecycleNode,
        *,
        parameters: SettingsParameters,
        prepare: Prepare,
        on_too_many: Callable[[str], Awaitable[None]],
        on_abandoned: Callable[[], None],
        on_device_lost: Callable[[str], None],
        rest_timeout_s: float,
    ) -> None:
        self._node = node
        self._rest_timeout_s = rest_timeout_s
        self._parameters = parameters
        self._on_too_many = on_too_many
        self._on_abandoned = on_abandoned
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
        self._removed: list[DetectorCamera] = []
        """Cameras whose last frame may still be in progress; see `end_removed`."""
        self.loader = ModelLoader(node, prepare, sizes_hw=self._sizes_hw, on_device_lost=on_device_lost)
        self.session: Session | None = None
        self._label_info: LifecyclePublisher | None = None
        self._loading_for: LifecyclePublisher | None = None

    def configure(self) -> None:
        """Create the publishers; raises rclpy's exception."""
        self._label_info = label_info_publisher(self._node)
        self._follow_parameters()

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

    def add_cameras(self, names: Sequence[str]) -> None:
        """Create the missing cameras, with publishers if configured. Raises rclpy's exception."""
        for name in names:
            if name and name not in self._cameras:
                self._node.get_logger().info(f"camera {name} added")
            camera = self._camera(name)
            if self._label_info is not None:
                camera.configure()

    def remove_cameras(self, *, except_for: Sequence[str]) -> None:
        """Receive no more frames of all other cameras; `end_removed` ends them."""
        removed = [self._cameras.pop(name) for name in [*self._cameras] if name not in except_for]
        for camera in removed:
            camera.end()
        self._removed += removed

    async def end_removed(self) -> None:
        """End the removed cameras while other callbacks are served; no frame stays pending in their balances.

        If the frame of one hangs, its thread is abandoned and keeps the network, so another one is prepared,
        as if more or fewer frames can be in progress at the same time with the present number of cameras.
        """
        while self._removed:
            camera = self._removed.pop()
            await self._waited(camera.rest)
            self._close(camera)
        session, executor = self.session, self._node.executor
        if session is not None and executor is not None and self._renewal(session):
            executor.create_task(self._renew, session)

    def _close(self, camera: DetectorCamera) -> None:
        log = self._node.get_logger()
        if not camera.close(self._rest_timeout_s):
            log.error(abandoned(self._rest_timeout_s))
            self._on_abandoned()
        log.info(f"camera {camera.name or '(without a name)'} removed: {camera.balance()}")

    def _renewal(self, session: Session) -> str:
        """Why `session` needs other networks; "" if it does not."""
        if session.networks is not None and self._worker.keeps_any(session.networks):
            return "the abandoned thread keeps the present one; frames may wait"
        count = most_lanes(self._parameters.settings())
        if count != most_lanes(session.model.settings):
            return f"up to {count} frames of the present cameras can be in progress at the same time"
        return ""

    async def _renew(self, session: Session) -> None:
        """Let `session` go on with other networks of the same model while there is a reason for them.

        An abandoned thread may end meanwhile: then frames go on with the present networks.
        """
        while self.session is session and (reason := self._renewal(session)):
            self._node.get_logger().info(f"preparing another network, because {reason}")
            present = session.preparation
            twin = await self.loader.twin(present.result(), self._parameters.settings())
            async with self.between_frames():
                is_wanted = session.preparation is present and self._renewal(session) != ""
                if self.session is session and is_wanted and twin.exception() is None:
                    session.apply(self._parameters.settings(), twin)
            if (error := twin.exception()) is not None:
                if self.session is session and is_wanted:
                    await self._report_missing(session, f"no other network can be prepared: {error}")
                return
            unused = present if session.preparation is twin else twin
            await self.loader.retire(unused.result(), after=session.rest)

    async def _report_missing(self, session: Session, problem: str) -> None:
        """Deactivate if frames wait for the network that could not be prepared, else go on without."""
        if session.networks is not None and self._worker.keeps_any(session.networks):
            await self._on_too_many(f"a hanging frame, because {problem}")
        else:
            self._node.get_logger().warning(f"going on with the present networks, because {problem}")

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
        # Until configured, changes of `cameras` are not applied, and `configure` refuses impossible names.
        if self._label_info is None and not impossible_names(self._node, self._names()):
            self._follow_parameters()
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
        """The size of each camera's last image; a common size for cameras that `settings` add."""
        present = {name: camera.last_image.size_hw for name, camera in self._cameras.items()}
        return [present.get(name, USUAL_SOURCE_HW) for name in settings.camera_names]

    def _follow_parameters(self) -> None:
        """Create and remove cameras to match the parameters."""
        names = self._names()
        self.add_cameras(names)
        self.remove_cameras(except_for=names)
        while self._removed:  # without a session no frame of theirs is in progress
            self._close(self._removed.pop())

    def _names(self) -> tuple[str, ...]:
        """The cameras that the parameters name; valid even if other settings are not."""
        return self._parameters.value("cameras") or ("",)

    def _camera(self, name: str) -> DetectorCamera:
        if name not in self._cameras:
            self._cameras[name] = DetectorCamera(
                self._node,
                name,
                names=self._names,
                worker=self._worker,
                failures=self._failures,
                track_ids=self._track_ids,
                collector=self._collecting.collector,
            )
        return self._cameras[name]

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
