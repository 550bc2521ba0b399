"""Cameras, publishers, session and collector, which transitions create and release, and their threads."""

from __future__ import annotations

import itertools
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from rclpy.node import Node
from rclpy.task import Future as RosFuture
from std_srvs.srv import Trigger

from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota, RecordingSession
from yolov5_lifecycle.collecting.collector import Collector
from yolov5_lifecycle.detection.prepared_model import Prepare, PreparedModel
from yolov5_lifecycle.process.memory import resident_mb
from yolov5_lifecycle.ros.detector.diagnostics import CameraStatus, Status
from yolov5_lifecycle.ros.detector.pipeline import Outputs, label_info_publisher
from yolov5_lifecycle.ros.detector.session import DetectorCamera, Preparation, Session
from yolov5_lifecycle.ros.detector.transforms import Tf2, TransformInput, Transforms
from yolov5_lifecycle.ros.nodes import namesakes
from yolov5_lifecycle.ros.parameters.settings_parameters import SettingsParameters
from yolov5_lifecycle.ros.topics import topic_problems
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.inference_threads import InferenceThreads

_CLOSE_TIMEOUT_S = 3.0
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


@dataclass(eq=False)
class ManagedResources:
    """Owns the cameras, their publishers from `configure` to `release`, and the session from `activate` to
    `deactivate`; the collector of images, and the service that asks for one.

    Models are prepared and freed one at a time in a thread of their own, from construction to `close`.
    `on_too_many(reason)`, whose result is awaited, and `on_device_lost(reason)`, also called when a model
    cannot be prepared because of that, are called in the executor; see `Session`. A frame in progress is
    waited for `rest_timeout_s`.
    """

    node: LifecycleNode
    _: KW_ONLY
    parameters: SettingsParameters
    prepare: Prepare
    on_too_many: Callable[[str], Awaitable[None]]
    on_device_lost: Callable[[str], None]
    rest_timeout_s: float
    listen: Callable[[Node], Transforms] = Tf2

    def __post_init__(self) -> None:
        self._cameras: dict[str, DetectorCamera] = {}
        self._track_ids = itertools.count(1)
        self._waits = Background(self.node, "waits")
        self._models = Background(self.node, "background")
        self._collector = _collector(self.parameters)
        self.node.create_service(Trigger, "~/collect", self._collect)
        self.session: Session | None = None
        self._abandoned: list[InferenceThreads] = []
        """Those of sessions in which a frame hung."""
        self._label_info: LifecyclePublisher | None = None
        self._loading_for: LifecyclePublisher | None = None

    def configure(self) -> None:
        """Create the publishers; raises rclpy's exception."""
        self._label_info = label_info_publisher(self.node)
        self._make_cameras()
        for camera in self._cameras.values():
            camera.outputs = Outputs(self.node, camera=camera.name, on_subscribers_changed=camera.update)

    async def load(self) -> bool:
        """Load the model while other callbacks are served; False if another transition was requested first.

        Then `session` exists, and `activate` starts it or raises what loading raised.
        """
        label_info = self._label_info
        if self._loading_for is label_info:
            self.node.get_logger().warning("activate refused: the model is already being loaded")
            return False
        self._loading_for = label_info
        preparation = await self.prepared(
            lambda: self.parameters.settings() if self._may_activate(label_info) else None
        )
        if self._loading_for is label_info:
            self._loading_for = None
        if preparation is None or label_info is None:
            self.node.get_logger().warning(
                "activate canceled because another transition arrived while the model was loading"
            )
            return False
        self.session = self._new_session(label_info, preparation)
        return True

    async def prepared(self, wanted: Callable[[], Settings | None]) -> Preparation | None:
        """Prepare the model for `wanted()`; repeat if other settings are wanted by then.

        Returns None as soon as `wanted()` does; models that are no longer wanted are freed.
        """
        while (settings := wanted()) is not None:
            preparation = await self._models.finish(self._prepare(settings))
            error = preparation.exception()
            if isinstance(error, DeviceLostError):
                self.on_device_lost(str(error))
            now_wanted = wanted()
            if now_wanted is not None and not settings.differing(now_wanted, Change.RELOAD):
                return preparation
            if error is None:
                preparation.result().close()
        return None

    async def is_outdated(self, model: PreparedModel) -> bool:
        """`model.is_outdated`, asked in the thread that loads models: a disk may hang."""
        return (await self._models.finish(self._models.submit(model.is_outdated))).result()

    async def retire(self, model: PreparedModel, session: Session) -> None:
        """Free `model` after its last frame in `session`, unless a hanging thread may still use it."""

        def free() -> None:
            has_rested = session.threads.rest(self.rest_timeout_s)
            model.close(is_at_rest=has_rested and not self.hanging_threads)

        if (error := (await self._models.finish(self._models.submit(free))).exception()) is not None:
            self.node.get_logger().error(f"the previous model could not be freed: {error}")

    def activate(self) -> Session:
        """Start the loaded session; if a program triggered the transition without `load`, load now.

        Raises what loading the model raises, and SettingsError if the settings do not fit it.
        """
        assert self._label_info is not None, "rclpy activates only a configured node"
        settings = self.parameters.settings()
        if self.session is None:
            self.session = self._new_session(self._label_info, self._prepare(settings))
        self.session.start(settings)
        return self.session

    @asynccontextmanager
    async def between_frames(self) -> AsyncIterator[None]:
        """In the block no frame is in progress, of any camera, unless one hangs; others are served before.

        The executor itself never waits for a frame.
        """
        if self.session is None:
            yield
            return
        threads = self.session.threads
        with threads.paused():
            if not threads.rest(0.0):
                await self._waits.finish(self._waits.submit(partial(threads.rest, self.rest_timeout_s)))
            yield

    def deactivate(self) -> bool:
        """Release the session; False if its frame hangs and it was abandoned.

        Call it `between_frames`: otherwise it waits for the frame in progress itself.
        """
        session, self.session = self.session, None
        if session is None:
            return True
        has_ended = session.stop(self.rest_timeout_s)
        if not has_ended:
            self._abandoned.append(session.threads)
        session.free(is_at_rest=not self.hanging_threads)  # that of an earlier session may hang in a GPU
        return has_ended

    def release(self) -> None:
        """Destroy the publishers; call after `deactivate`."""
        for camera in self._cameras.values():
            if camera.outputs is not None:
                camera.outputs.close()
                camera.outputs = None
        if self._label_info is not None:
            # destroy_publisher would leave it in the list of managed entities.
            self.node.destroy_lifecycle_publisher(self._label_info)
            self._label_info = None

    def close(self) -> None:
        """End the threads; those that hang are abandoned and logged. Call after `release`."""
        log = self.node.get_logger()
        if not self._models.close():
            log.warning("a model is still being loaded or freed: its thread is abandoned")
        if self.hanging_threads:
            log.warning("inference has still not finished: its thread is abandoned")
        if self._collector is not None and not self._collector.close(_CLOSE_TIMEOUT_S):
            log.warning(
                f"an image has not been written within {_CLOSE_TIMEOUT_S:g} s: its thread is abandoned"
            )
        self._waits.close()

    @property
    def hanging_sessions(self) -> int:
        """Number of abandoned sessions in which a frame still hangs."""
        self._abandoned = [threads for threads in self._abandoned if threads.hanging]
        return len(self._abandoned)

    @property
    def hanging_threads(self) -> int:
        """Number of inference threads of abandoned sessions that have not ended yet."""
        return sum(threads.hanging for threads in self._abandoned)

    def update(self) -> None:
        """Adapt cameras and subscriptions to parameters and to the ROS graph."""
        if self._label_info is None and not topic_problems(self.node, self._names()):
            self._make_cameras()  # `configure` refuses them
        for name, camera in self._cameras.items():
            camera.update()
            if camera.active is None:
                camera.use(self.parameters.value_for(name, "image_transport"))

    def status(self, state: str, problem: str) -> Status:
        """Snapshot of the node in the lifecycle state `state`, with the last `problem` that was reported."""
        return Status(
            state=state,
            problem=problem,
            settings=self.parameters.settings() if self._label_info else None,
            model=self.session.model if self.session else None,
            cameras=tuple(CameraStatus(camera, camera.topic.look()) for camera in self._cameras.values()),
            abandoned_threads=self.hanging_threads,
            resident_mb=resident_mb(),
            collected=self._collector.status if self._collector else None,
            namesakes=namesakes(self.node),
        )

    def _collect(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Keep the next image of each camera that collects."""
        if self._collector is None:
            response.message = "there is no folder: restart the node with collect_dir set to one"
            return response
        asked = []
        for name, camera in self._cameras.items():
            if camera.active is not None and camera.active.collecting is not None:
                camera.active.collecting.request()
                asked.append(name)
        if problem := self._collector.status.problem:
            response.message = f"no image was kept at the last attempt: {problem}"
        elif not asked:
            response.message = "no camera collects: activate the node, and set collect to true"
        else:
            names = ", ".join(filter(None, asked))
            response.success = True
            response.message = f"the next image{f' of {names}' if names else ''} is kept"
        return response

    def _prepare(self, settings: Settings) -> Preparation:
        """Queue the preparation of the model, warmed up with the size of each camera's last image."""
        sizes_hw = [self._cameras[name].last_image.size_hw for name in settings.camera_names]
        return self._models.submit(lambda: self.prepare(settings, sizes_hw))

    def _make_cameras(self) -> None:
        """Those that the parameters name; the others, which have no publishers any more, end."""
        names = self._names()
        for name in self._cameras.keys() - names:
            del self._cameras[name]
        for name in names:
            if name not in self._cameras:
                self._cameras[name] = DetectorCamera(self.node, name, self._names)

    def _names(self) -> tuple[str, ...]:
        """The cameras that the parameters name; valid even if other settings are not."""
        return self.parameters.value("cameras") or ("",)

    def _may_activate(self, label_info: LifecyclePublisher | None) -> bool:
        """Whether the configuration with `label_info` still exists and is not active."""
        return self._label_info is label_info and self.session is None

    def _new_session(self, label_info: LifecyclePublisher, preparation: Preparation) -> Session:
        return Session(
            self.node,
            preparation=preparation,
            cameras=self._cameras,
            label_info=label_info,
            track_ids=self._track_ids,
            collector=self._collector,
            on_too_many=self.on_too_many,
            on_device_lost=self.on_device_lost,
            transforms=TransformInput(self.node, self.listen),
        )


def _collector(parameters: SettingsParameters) -> Collector | None:
    """Keeps images in `collect_dir`, which like the quota is that of the start; None without one."""
    folder = str(parameters.value("collect_dir"))
    if not folder:
        return None
    quota = Quota(
        max_bytes=parameters.value("collect_max_mb") * 1_000_000,
        min_free_bytes=parameters.value("collect_min_free_mb") * 1_000_000,
    )
    session = RecordingSession()
    return Collector(lambda: CollectedFolder(Path(folder).expanduser(), quota, session=session))
