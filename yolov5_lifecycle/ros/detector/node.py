"""The lifecycle node, which connects parameters, model, worker and topics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from yolov5_lifecycle.detection.prepared_model import Prepare, check_place, prepare_model
from yolov5_lifecycle.printable import in_lines, in_one_line
from yolov5_lifecycle.ros.detector.bond import Bond, check_bond
from yolov5_lifecycle.ros.detector.diagnostics import Diagnostics
from yolov5_lifecycle.ros.detector.exit_codes import EXIT_ABANDONED_THREADS, EXIT_DEVICE_LOST
from yolov5_lifecycle.ros.detector.managed_resources import ManagedResources
from yolov5_lifecycle.ros.detector.model_loader import REFUSALS
from yolov5_lifecycle.ros.detector.reconfiguration import Reconfiguration
from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S, abandoned
from yolov5_lifecycle.ros.detector.transitions import (
    FAILURE,
    SUCCESS,
    logged,
    refused_transition,
    requested_label,
)
from yolov5_lifecycle.ros.parameters.configuration_problems import corrections
from yolov5_lifecycle.ros.parameters.settings_parameters import SettingsParameters, Validate
from yolov5_lifecycle.ros.printable_logger import PrintableNode
from yolov5_lifecycle.ros.qos_overrides import qos_problems, qos_rules
from yolov5_lifecycle.ros.rclpy_internals import (
    ForgettingGroup,
    available_transitions,
    destroy_state_machine,
    lifecycle_state,
)
from yolov5_lifecycle.ros.services import wrap_services
from yolov5_lifecycle.ros.topics import impossible_names, remapping_problems
from yolov5_lifecycle.settings.camera_overrides import CAMERAS
from yolov5_lifecycle.settings.settings import validated
from yolov5_lifecycle.streaming.worker import MAX_ABANDONED_THREADS


class DetectorNode(PrintableNode, LifecycleNode):
    """YOLOv5 as a managed node: maps its transitions and services to parameters, resources and diagnostics.

    `prepare` creates a model from settings, `validate` settings from values; tests pass their own.
    `arguments` are the command-line arguments. `start_problems` are parameter files that could not be read
    and values that contradict each other: reported at once; configure fails until the process is restarted.

    A frame in progress is waited for `rest_timeout_s`; diagnostics come every `diagnostics_period_s`.

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
        rest_timeout_s: float = REST_TIMEOUT_S,
        diagnostics_period_s: float = 1.0,
        **node_options: Any,
    ) -> None:
        # Callbacks that await (activate, a reload) must not block the others. The executor has one thread, so
        # callbacks never run in parallel even in a reentrant group.
        self._group = ForgettingGroup()
        super().__init__("yolov5", **node_options)
        self._start_problems = list(start_problems)
        self._max_abandoned_threads = max_abandoned_threads
        self._rest_timeout_s = rest_timeout_s
        self._problem = ""
        self._is_qos_checked = False
        self.device_lost = False
        self.too_many_abandoned = False
        self._settings = self._declared_settings(validate, arguments)
        self._resources = ManagedResources(
            self,
            parameters=self._settings,
            prepare=prepare,
            on_too_many=self._give_up,
            on_device_lost=self._lose_device,
            rest_timeout_s=rest_timeout_s,
        )
        self._reconfiguration = Reconfiguration(
            self, parameters=self._settings, loader=self._resources.loader, resources=self._resources
        )
        self._diagnostics = Diagnostics(
            self,
            lambda: self._resources.status(self.state_label, self._problem),
            period_s=diagnostics_period_s,
        )
        self._bond = Bond(self)
        wrap_services(self, {"change_state": self._change_state} | self._reconfiguration.handlers())
        self._greet()

    @property
    def default_callback_group(self) -> CallbackGroup:
        return self._group

    @property
    def state_label(self) -> str:
        """Name of the lifecycle state, such as `inactive`."""
        return lifecycle_state(self)

    def report(self, problem: str) -> None:
        """Log `problem` now and show it in diagnostics until the next success."""
        self._problem = in_lines(problem)
        self.get_logger().error(problem)

    async def autostart(self) -> None:
        """Configure and activate if the parameter `autostart` is set."""
        if (
            self._settings.value("autostart")
            and self.trigger_configure() is SUCCESS
            and await self._resources.load()
        ):
            self.trigger_activate()

    def close(self) -> None:
        """Shut down from any state and release everything; a hung thread is abandoned and logged."""
        if self.state_label in ("unconfigured", "inactive", "active"):
            self.trigger_shutdown()
        self._resources.close()
        self.destroy_node()
        destroy_state_machine(self)

    @logged
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        cameras = self._settings.value("cameras") or ("",)
        of_parameters = self._settings.problems()
        problems = [
            *map(in_one_line, self._start_problems),
            *self._topic_problems(
                cameras, are_undecided=any(problem.setting == CAMERAS for problem in of_parameters)
            ),
            *(in_one_line(str(problem)) for problem in of_parameters),
        ]
        if problems:
            heading = f"configure refused, {len(problems)} problem(s):"
            self.report(
                "\n  ".join(
                    [heading, *problems, *corrections(of_parameters, self.get_fully_qualified_name())]
                )
            )
            return FAILURE
        self._is_qos_checked = True
        settings = self._settings.settings()
        try:
            check_place(settings)
            check_bond(settings.bond_timeout)
        except ValueError as error:
            self.report(f"configure refused: {error}")
            return FAILURE
        self._settings.forget_unusable()
        self.get_logger().info("configured with\n" + self._settings.table())
        self._resources.configure()
        self._problem = ""
        return super().on_configure(state)

    @logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            session = self._resources.activate()
        except REFUSALS as error:
            self._resources.deactivate()
            self.report(f"activate refused: {in_one_line(str(error))}")
            return FAILURE
        self._problem = ""
        self.get_logger().info(f"active with {session.model.summary}")
        result = super().on_activate(state)
        session.publish_first(self._settings.settings())
        self._bond.start(self._settings.settings().bond_timeout)
        return result

    @logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._stop_detecting()
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

    def _declared_settings(self, validate: Validate, arguments: Sequence[str]) -> SettingsParameters:
        return SettingsParameters(
            self,
            rules=qos_rules(self),
            arguments=arguments,
            validate=validate,
            is_unconfigured=lambda: self.state_label == "unconfigured",
        )

    def _topic_problems(self, cameras: Sequence[str], *, are_undecided: bool) -> list[str]:
        """Problems of these cameras, to which others may be added, with their topics or QoS overrides."""
        if problems := impossible_names(self, cameras):
            return problems
        # The overrides are fixed, but their camera may be gone since.
        of_qos = [] if self._is_qos_checked else qos_problems(self, cameras, are_undecided=are_undecided)
        return [*remapping_problems(self, cameras), *(in_one_line(str(problem)) for problem in of_qos)]

    def _greet(self) -> None:
        if self._start_problems:
            self.report("\n  ".join(self._start_problems))
        else:
            name = self.get_fully_qualified_name()
            self.get_logger().info(f"unconfigured; next step: ros2 lifecycle set {name} configure")

    def _release(self) -> TransitionCallbackReturn:
        """Release everything that configure and activate created, from any state."""
        self._stop_detecting()
        self._resources.release()
        return SUCCESS

    def _stop_detecting(self) -> None:
        self._bond.stop()
        if not self._resources.deactivate():
            self.report(abandoned(self._rest_timeout_s))
            self._bound_abandoned_threads()

    def _bound_abandoned_threads(self) -> None:
        count = self._resources.abandoned_threads()
        if count > self._max_abandoned_threads:
            self.report(
                f"exiting (code {EXIT_ABANDONED_THREADS}): {count} inference threads hang, the limit is "
                f"{self._max_abandoned_threads}"
            )
            self._diagnostics.publish()
            self.too_many_abandoned = True

    async def _change_state(self, request: Any, response: Any) -> Any:
        wanted, possible = request.transition, available_transitions(self)
        label = requested_label(wanted, possible)
        if label is None:
            refusal = refused_transition(wanted, possible, self.state_label)
            self.get_logger().warning(refusal, throttle_duration_sec=1.0)
        elif label == "activate":
            response.success = await self._resources.load() and self.trigger_activate() is SUCCESS
        else:
            response.success = await self._trigger_at_rest(label)
        return response

    async def _trigger_at_rest(self, label: str) -> bool:
        """Trigger a transition once the frame in progress has ended or hangs; return its success."""
        before = self.state_label
        with self._resources.paused():
            await self._resources.rest()
            if self.state_label == before:
                return getattr(self, f"trigger_{label}")() is SUCCESS
        self.get_logger().warning(
            f"{label} canceled because another transition arrived while a frame was in progress"
        )
        return False

    async def _give_up(self, reason: str) -> None:
        if self.state_label == "active" and await self._trigger_at_rest("deactivate"):
            self.report(f"deactivated after {reason}")

    def _lose_device(self, reason: str) -> None:
        self.report(f"exiting (code {EXIT_DEVICE_LOST}) because the device is lost: {reason}")
        self._diagnostics.publish()
        self.device_lost = True
