"""The lifecycle node, which connects parameters, model, worker and topics."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from yolov5_lifecycle.detection.prepared_model import Prepare, check_place, prepare_model
from yolov5_lifecycle.detection.selection import model_problems
from yolov5_lifecycle.printable import in_lines, in_one_line
from yolov5_lifecycle.process.memory import resident_mb
from yolov5_lifecycle.ros.detector.activation import ActivationModel
from yolov5_lifecycle.ros.detector.bond import Bond, check_bond
from yolov5_lifecycle.ros.detector.diagnostics import Diagnostics
from yolov5_lifecycle.ros.detector.frame_failures import FrameFailures
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.image_topic import ImageTopic
from yolov5_lifecycle.ros.detector.model_loader import REFUSALS, ModelLoader
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.ros.detector.pipeline import DetectedFrame, LastPicture
from yolov5_lifecycle.ros.detector.reconfiguration import Reconfiguration
from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S, Detection
from yolov5_lifecycle.ros.detector.status import Status
from yolov5_lifecycle.ros.detector.transitions import (
    FAILURE,
    SUCCESS,
    logged,
    refused_transition,
    requested_label,
)
from yolov5_lifecycle.ros.parameters import Validate
from yolov5_lifecycle.ros.printable_logger import PrintableLogger
from yolov5_lifecycle.ros.services import harden
from yolov5_lifecycle.ros.topics import remapping_problems
from yolov5_lifecycle.settings.settings import Settings, validated
from yolov5_lifecycle.streaming.worker import MAX_ABANDONED_THREADS, Worker


class DetectorNode(LifecycleNode):
    """YOLOv5 as a managed node.

    Owns the parameters, inference worker, model loader and diagnostics from construction to `close`; the
    publishers from configure to cleanup; the `Detection` (model and image subscription) while active.

    `prepare` creates a model from settings, `validate` settings from values; tests pass their own.
    `arguments` are the command-line arguments. `start_problems` are parameter files that could not be read
    and values that contradict each other: reported at once; configure fails until the process is restarted.

    `device_lost` is set when only a new process can detect again, `too_many_abandoned` when more than
    `max_abandoned_threads` inference threads hang.
    """

    def __init__(
        self,
        *,
        prepare: Prepare = prepare_model,
        validate: Validate = validated,
        arguments: Sequence[str] = (),
        start_problems: Sequence[str] = (),
        max_abandoned_threads: int = MAX_ABANDONED_THREADS,
        **node_options: Any,
    ) -> None:
        # Callbacks that await (activate, a reload) must not block the others. The executor has one thread, so
        # callbacks never run in parallel even in a reentrant group.
        self._group = ReentrantCallbackGroup()
        self._printable_logger: PrintableLogger | None = None
        super().__init__("yolov5", **node_options)
        self._start_problems = list(start_problems)
        self._problem = ""
        self._settings: Settings | None = None
        self._outputs: Outputs | None = None
        self._detection: Detection | None = None
        self.device_lost = False
        self.too_many_abandoned = False
        self._max_abandoned_threads = max_abandoned_threads
        self._failures = FrameFailures(self, on_too_many=self._give_up, on_device_lost=self._lose_device)
        self._worker: Worker[ReceivedFrame, DetectedFrame] = Worker(
            on_failure=self._failures.failed, on_success=self._failures.succeeded
        )
        self._topic = ImageTopic(self, "raw")
        self._last_picture = LastPicture()
        self._loader = ModelLoader(
            self, prepare, last_picture=self._last_picture, on_device_lost=self._lose_device
        )
        self._activation_model = ActivationModel(
            self, self._loader, configuration=lambda: self._outputs, settings=lambda: self._settings
        )
        self._reconfiguration = Reconfiguration(
            self,
            loader=self._loader,
            running=lambda: self._detection,
            on_commit=self._keep_settings,
            arguments=arguments,
            validate=validate,
        )
        self._diagnostics = Diagnostics(self, self._status)
        self._bond = Bond(self)
        harden(self, {"change_state": self._change_state} | self._reconfiguration.handlers())
        name = self.get_fully_qualified_name()
        if self._start_problems:
            self.report("\n  ".join(self._start_problems))
        else:
            self.get_logger().info(f"unconfigured; go on with: ros2 lifecycle set {name} configure")

    def get_logger(self) -> RcutilsLogger:
        """Logger that makes messages printable, also for rclpy's own messages."""
        if self._printable_logger is None:
            self._printable_logger = PrintableLogger(super().get_logger().name)
        return self._printable_logger

    @property
    def default_callback_group(self) -> CallbackGroup:
        return self._group

    @property
    def state_label(self) -> str:
        """Name of the lifecycle state, such as `inactive`."""
        # rclpy exposes the state only through a service.
        return str(self._state_machine.current_state[1])

    def report(self, problem: str) -> None:
        """Log `problem` now and show it in diagnostics until the next success."""
        self._problem = in_lines(problem)
        self.get_logger().error(problem)

    async def autostart(self) -> None:
        """Configure and activate if the parameter `autostart` is set."""
        if (
            self.get_parameter("autostart").value
            and self.trigger_configure() is SUCCESS
            and await self._activation_model.load()
        ):
            self.trigger_activate()

    def close(self) -> None:
        """Shut down from any state and release everything; a hung thread is abandoned and logged."""
        if self.state_label in ("unconfigured", "inactive", "active"):
            self.trigger_shutdown()
        if not self._loader.close():
            self.get_logger().warning("a model is still being loaded or freed: its thread is left behind")
        if not self._worker.close(REST_TIMEOUT_S):
            self.get_logger().warning("inference still has not ended: its thread is left behind")
        self.destroy_node()
        # destroy_node leaves the state machine's services, which would still accept requests.
        self._state_machine.destroy_when_not_in_use()

    @logged
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        parameters = self._reconfiguration.parameters
        problems = [
            *map(in_one_line, self._start_problems),
            *remapping_problems(self),
            *(in_one_line(str(problem)) for problem in parameters.problems()),
        ]
        if problems:
            self.report("\n  ".join([f"configure refused, {len(problems)} problem(s):", *problems]))
            return FAILURE
        settings = parameters.settings()
        try:
            check_place(settings)
            check_bond(settings.bond_timeout)
        except ValueError as error:
            self.report(f"configure refused: {error}")
            return FAILURE
        self.get_logger().info("configured with\n" + parameters.table())
        self._settings = settings
        self._outputs = Outputs(self, on_subscribers_changed=self._follow_subscribers)
        self._problem = ""
        return super().on_configure(state)

    @logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        assert self._settings is not None
        assert self._outputs is not None
        try:
            model = self._activation_model.take(self._settings).result()
        except REFUSALS as error:
            self.report(f"activate refused: {in_one_line(str(error))}")
            return FAILURE
        if problems := model_problems(self._settings, model.detector.class_names):
            model.close()
            self.report("activate refused: " + in_one_line(" ".join(map(str, problems))))
            return FAILURE
        self._detection = Detection(
            self,
            settings=self._settings,
            model=model,
            topic=self._topic,
            outputs=self._outputs,
            worker=self._worker,
            last_picture=self._last_picture,
        )
        self._failures.succeeded()
        self._problem = ""
        self.get_logger().info(f"active with {model.summary}")
        result = super().on_activate(state)
        self._detection.publish_label_info()
        self._detection.follow_subscribers()
        self._bond.start(self._settings.bond_timeout)
        return result

    @logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._drop_detection()
        return super().on_deactivate(state)

    @logged
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._release()

    @logged
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._release()

    @logged
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._release()

    def _release(self) -> TransitionCallbackReturn:
        """Release everything that configure and activate created, from any state."""
        self._drop_detection()
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None
        self._settings = None
        return SUCCESS

    def _drop_detection(self) -> None:
        self._bond.stop()
        detection, self._detection = self._detection, None
        if detection is not None and not detection.close():
            self.report(f"inference did not end within {REST_TIMEOUT_S:g} s: its thread was abandoned")
            self._bound_abandoned_threads()

    def _bound_abandoned_threads(self) -> None:
        count = self._worker.abandoned_threads()
        if count > self._max_abandoned_threads:
            self.report(
                f"{count} inference threads hang and keep their memory, more than "
                f"{self._max_abandoned_threads}: this process ends"
            )
            self._diagnostics.publish()
            self.too_many_abandoned = True

    async def _change_state(self, request: Any, response: Any) -> Any:
        wanted, possible = request.transition, self._state_machine.available_transitions
        label = requested_label(wanted, possible)
        if label is None:
            refusal = refused_transition(wanted, possible, self.state_label)
            self.get_logger().warning(refusal, throttle_duration_sec=1.0)
        elif label != "activate" or await self._activation_model.load():
            response.success = getattr(self, f"trigger_{label}")() is SUCCESS
        return response

    def _keep_settings(self, settings: Settings) -> None:
        if self._settings is not None:
            self._settings = settings

    def _follow_subscribers(self) -> None:
        if self._detection is not None:
            self._detection.follow_subscribers()

    def _give_up(self, reason: str) -> None:
        if self.state_label == "active":
            self.trigger_deactivate()
            self.report(f"deactivated after {reason}")

    def _lose_device(self, reason: str) -> None:
        self.report(f"the device is lost to this process, which ends: {reason}")
        self._diagnostics.publish()
        self.device_lost = True

    def _status(self) -> Status:
        detection = self._detection
        if detection is None:
            self._topic.follow(self.get_parameter("image_transport").value)
        topic = self._topic.look()
        image_input = detection.look(topic) if detection else None
        return Status(
            state=self.state_label,
            problem=self._problem or (detection.problem if detection else ""),
            balance=self._worker.balance(),
            topic=topic,
            settings=self._settings,
            model=detection.model if detection else None,
            input=image_input,
            lost=detection.losses.lost if detection else None,
            overtaken=detection.losses.overtaken if detection else None,
            latency=detection.latencies.summary(time.monotonic()) if detection else None,
            empty=detection.empty_frames.run if detection else None,
            busy_s=self._worker.busy_s(),
            recently_rejected=self._failures.recent_rejection(),
            abandoned_threads=self._worker.abandoned_threads(),
            resident_mb=resident_mb(),
        )
