"""The lifecycle node: joins parameters, model, worker and topics."""

from __future__ import annotations

import functools
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from yolov5_lifecycle.one_line import in_one_line
from yolov5_lifecycle.preparation import Prepare, check_place, prepare_model
from yolov5_lifecycle.ros.detection import REST_TIMEOUT_S, Detection
from yolov5_lifecycle.ros.diagnostics import Diagnostics
from yolov5_lifecycle.ros.frame_failures import FrameFailures
from yolov5_lifecycle.ros.image_input import ReceivedFrame
from yolov5_lifecycle.ros.last_picture import LastPicture
from yolov5_lifecycle.ros.loading import REFUSALS, ModelLoader, Preparation
from yolov5_lifecycle.ros.outputs import Outputs
from yolov5_lifecycle.ros.reconfiguration import Reconfiguration
from yolov5_lifecycle.ros.services import harden
from yolov5_lifecycle.ros.status import Status
from yolov5_lifecycle.selection import model_problems
from yolov5_lifecycle.settings import Settings
from yolov5_lifecycle.worker import Worker

SUCCESS, FAILURE, ERROR = (
    TransitionCallbackReturn.SUCCESS,
    TransitionCallbackReturn.FAILURE,
    TransitionCallbackReturn.ERROR,
)
Transition = Callable[["DetectorNode", LifecycleState], TransitionCallbackReturn]


def logged(transition: Transition) -> Transition:
    """Log what rclpy swallows: an exception in a transition becomes a silent ERROR (ros2/rclpy#1673)."""

    @functools.wraps(transition)
    def guarded(node: DetectorNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except Exception as error:  # noqa: BLE001 - logged with its traceback, answered with ERROR
            node.report(f"unexpected {type(error).__name__} in {transition.__name__}: {error}")
            node.get_logger().error(traceback.format_exc())
            return ERROR

    return guarded


class DetectorNode(LifecycleNode):
    """YOLOv5 as a managed node.

    Owns the parameters, the inference worker, the model loader and the diagnostics from birth to `close`; the
    publishers from configure to cleanup; the `Detection` (model and image subscription) while active.

    `prepare` makes a model from settings; tests pass one of their own. `arguments` are the words of the
    command line. `parameter_file_error` says why a parameter file could not be read at all; configure refuses
    until the process is started with a good one.

    `device_lost` becomes true when only a new process can detect again.
    """

    def __init__(
        self,
        *,
        prepare: Prepare = prepare_model,
        arguments: Sequence[str] = (),
        parameter_file_error: str = "",
        **node_options: Any,
    ) -> None:
        # Callbacks that await (activate, a reload) must not hold the others up. The executor has one thread,
        # so nothing runs at the same time even in a reentrant group.
        self._group = ReentrantCallbackGroup()
        super().__init__("yolov5", **node_options)
        self._parameter_file_error = parameter_file_error
        self._problem = ""
        self._settings: Settings | None = None
        self._outputs: Outputs | None = None
        self._detection: Detection | None = None
        self._preparation: Preparation | None = None
        self._loading_for: Outputs | None = None
        self.device_lost = False
        self._failures = FrameFailures(self, on_too_many=self._give_up, on_device_lost=self._lose_device)
        self._worker: Worker[ReceivedFrame] = Worker(
            on_failure=self._failures.failed, on_success=self._failures.succeeded
        )
        self._last_picture = LastPicture()
        self._loader = ModelLoader(
            self, prepare, last_picture=self._last_picture, on_device_lost=self._lose_device
        )
        self._reconfiguration = Reconfiguration(
            self,
            loader=self._loader,
            running=lambda: self._detection,
            on_commit=self._keep_settings,
            arguments=arguments,
        )
        self._diagnostics = Diagnostics(self, self._status)
        harden(self, {"change_state": self._change_state} | self._reconfiguration.handlers())
        name = self.get_fully_qualified_name()
        self.get_logger().info(f"unconfigured; go on with: ros2 lifecycle set {name} configure")

    @property
    def default_callback_group(self) -> CallbackGroup:
        return self._group

    @property
    def state_label(self) -> str:
        """Name of the lifecycle state, such as `inactive`."""
        # rclpy offers the state through a service alone.
        return str(self._state_machine.current_state[1])

    def report(self, problem: str) -> None:
        """Tell the log now, and diagnostics until the next success."""
        self._problem = problem
        self.get_logger().error(problem)

    async def autostart(self) -> None:
        """Configure and activate, if the parameter `autostart` asks for it."""
        if (
            self.get_parameter("autostart").value
            and self.trigger_configure() is SUCCESS
            and await self._load()
        ):
            self.trigger_activate()

    def close(self) -> None:
        """Shut down from any state and release everything; a thread that hangs is left behind and logged."""
        if self.state_label in ("unconfigured", "inactive", "active"):
            self.trigger_shutdown()
        if not self._loader.close():
            self.get_logger().warning("a model is still being loaded or freed: its thread is left behind")
        if not self._worker.close(REST_TIMEOUT_S):
            self.get_logger().warning("inference still has not ended: its thread is left behind")
        self.destroy_node()
        # destroy_node leaves the state machine's services, which would go on taking requests.
        self._state_machine.destroy_when_not_in_use()

    @logged
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        parameters = self._reconfiguration.parameters
        problems = [*filter(None, [self._parameter_file_error]), *map(str, parameters.problems())]
        if problems:
            self.report(
                "\n  ".join([f"configure refused, {len(problems)} problem(s) in the parameters:", *problems])
            )
            return FAILURE
        settings = parameters.settings()
        try:
            check_place(settings)
        except ValueError as error:
            self.report(f"configure refused: {error}")
            return FAILURE
        self.get_logger().info("configured with\n" + parameters.table())
        self._settings = settings
        self._outputs = Outputs(self, on_listeners_changed=self._follow_listeners)
        self._problem = ""
        return super().on_configure(state)

    @logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        assert self._settings is not None
        assert self._outputs is not None
        preparation, self._preparation = self._preparation or self._loader.begin(self._settings), None
        try:
            model = preparation.result()
        except REFUSALS as error:
            self.report(f"activate refused: {error}")
            return FAILURE
        if problems := model_problems(self._settings, model.detector.class_names):
            model.close()
            self.report("activate refused: " + " ".join(map(str, problems)))
            return FAILURE
        self._detection = Detection(
            self,
            settings=self._settings,
            model=model,
            outputs=self._outputs,
            worker=self._worker,
            last_picture=self._last_picture,
        )
        self._failures.succeeded()
        self._problem = ""
        self.get_logger().info(f"active with {model.summary}")
        result = super().on_activate(state)
        self._detection.publish_label_info()
        self._detection.follow_listeners()
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
        """Give back everything that configure and activate made, whatever there is of it."""
        self._drop_detection()
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None
        self._settings = None
        return SUCCESS

    def _drop_detection(self) -> None:
        detection, self._detection = self._detection, None
        if detection is not None and not detection.close():
            self.report(f"inference did not end within {REST_TIMEOUT_S:g} s: its thread was given up")

    async def _change_state(self, request: Any, response: Any) -> Any:
        wanted, possible = request.transition, self._state_machine.available_transitions
        labels = [
            row[1] for row in possible if (row[1] == wanted.label if wanted.label else row[0] == wanted.id)
        ]
        if not labels:
            asked = in_one_line(wanted.label[:100]) or wanted.id
            self.get_logger().warning(
                f"transition '{asked}' refused in state {self.state_label}. "
                f"Possible now: {', '.join(f'{row[1]} ({row[0]})' for row in possible) or 'none'}.",
                throttle_duration_sec=1.0,
            )
            return response
        if labels[0] == "activate" and not await self._load():
            return response
        response.success = getattr(self, f"trigger_{labels[0]}")() is SUCCESS
        return response

    async def _load(self) -> bool:
        """Load the model for activate while others are answered; False when another transition came first."""
        outputs = self._outputs  # made by configure, so they tell one configuration from the next
        if self._loading_for is outputs:
            self.get_logger().warning("activate refused: the model is being loaded already")
            return False
        self._loading_for = outputs
        preparation = await self._loader.load(lambda: self._settings if self._outputs is outputs else None)
        if self._loading_for is outputs:
            self._loading_for = None
        if preparation is None:
            self.get_logger().warning(
                "activate given up: another transition came while the model was loading"
            )
            return False
        self._preparation = preparation
        return True

    def _keep_settings(self, settings: Settings) -> None:
        if self._settings is not None:
            self._settings = settings

    def _follow_listeners(self) -> None:
        if self._detection is not None:
            self._detection.follow_listeners()

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
        return Status(
            state=self.state_label,
            problem=self._problem,
            balance=self._worker.balance(),
            settings=self._settings,
            model=detection.model if detection else None,
            input=detection.look() if detection else None,
            latency=detection.latencies.summary(time.monotonic()) if detection else None,
            empty=detection.empty_frames.run if detection else None,
            busy_s=self._worker.busy_s(),
            recently_rejected=self._failures.recent_rejection(),
        )
