"""The lifecycle node, which connects parameters, model, inference and topics."""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from yolov5_lifecycle.detection.prepared_model import Prepare, check_place, prepare_model
from yolov5_lifecycle.printable import in_lines, in_one_line
from yolov5_lifecycle.ros.detector.bond import Bond, status_type
from yolov5_lifecycle.ros.detector.diagnostics import Diagnostics, Status
from yolov5_lifecycle.ros.detector.managed_resources import ManagedResources
from yolov5_lifecycle.ros.detector.reconfiguration import Reconfiguration
from yolov5_lifecycle.ros.detector.session import MAX_ABANDONED_SESSIONS, REFUSALS, REST_TIMEOUT_S
from yolov5_lifecycle.ros.detector.transforms import Tf2, Transforms
from yolov5_lifecycle.ros.nodes import PrintableNode
from yolov5_lifecycle.ros.parameters.settings_parameters import SettingsParameters
from yolov5_lifecycle.ros.rclpy_internals import (
    ForgettingGroup,
    available_transitions,
    destroy_state_machine,
    lifecycle_state,
)
from yolov5_lifecycle.ros.services import wrap_services
from yolov5_lifecycle.ros.topics import qos_problems, topic_problems
from yolov5_lifecycle.settings.camera_overrides import CAMERAS

EXIT_DEVICE_LOST = 3
"""The GPU is lost; restart the process."""

EXIT_ABANDONED_SESSIONS = 4
"""Inference hangs in too many abandoned sessions; restart the process, which frees their memory."""


SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE

Transition = Callable[["DetectorNode", LifecycleState], TransitionCallbackReturn]


def logged(transition: Transition) -> Transition:
    """Log an exception in a transition, which rclpy turns into a silent ERROR (ros2/rclpy#1673)."""

    @functools.wraps(transition)
    def guarded(node: DetectorNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except Exception as error:  # noqa: BLE001 - logged with its traceback, answered with ERROR
            node.report(f"unexpected {type(error).__name__} in {transition.__name__}: {error}")
            node.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR

    return guarded


def requested_label(wanted: Any, possible: Sequence[tuple[Any, ...]]) -> str | None:
    """Label of the transition that the `lifecycle_msgs/Transition` `wanted` requests, None if not possible.

    `possible`: rows (id, label, ...). A label takes precedence over an id. For an impossible transition rclpy
    would raise (ros2/rclpy#1209).
    """
    column, value = (1, wanted.label) if wanted.label else (0, wanted.id)
    return next((str(row[1]) for row in possible if row[column] == value), None)


class DetectorNode(PrintableNode, LifecycleNode):
    """YOLOv5 as a managed node: maps its transitions and services to parameters, resources and diagnostics.

    `prepare` creates a model from settings, `listen` receives transforms; tests pass their own.

    `start_problems` are parameter files that could not be read and values that contradict each other:
    reported at once; configure fails until the process is restarted.

    A frame in progress is waited for `rest_timeout_s`; diagnostics come every `diagnostics_period_s`.

    `exit_code` is set when only a new process can detect again: the device is lost, or frames hang in more
    than MAX_ABANDONED_SESSIONS abandoned sessions.
    """

    def __init__(
        self,
        *,
        prepare: Prepare = prepare_model,
        listen: Callable[[Node], Transforms] = Tf2,
        start_problems: Sequence[str] = (),
        rest_timeout_s: float = REST_TIMEOUT_S,
        diagnostics_period_s: float = 1.0,
        **node_options: Any,
    ) -> None:
        # Callbacks that await (activate, a reload) must not block the others. The executor has one thread, so
        # callbacks never run in parallel even in a reentrant group.
        self._group = ForgettingGroup()
        super().__init__("yolov5", **node_options)
        self._start_problems = list(start_problems)
        self._rest_timeout_s = rest_timeout_s
        self._problem = ""
        self._is_qos_checked = False
        self.exit_code: int | None = None
        self._settings = SettingsParameters(self)
        self._resources = ManagedResources(
            self,
            parameters=self._settings,
            prepare=prepare,
            listen=listen,
            on_too_many=self._give_up,
            on_device_lost=self._lose_device,
            rest_timeout_s=rest_timeout_s,
        )
        self._reconfiguration = Reconfiguration(self, self._settings, self._resources)
        self._diagnostics = Diagnostics(self, self._status, period_s=diagnostics_period_s)
        self._bond: Bond | None = None
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
        problems = [
            *self._start_problems,
            *self._topic_problems(cameras),
            *self._settings.explained_problems(),
        ]
        if problems:
            heading = f"configure refused, {len(problems)} problem(s):"
            lines = [heading, *map(in_one_line, problems), *self._settings.correction()]
            self.report("\n  ".join(lines))
            return FAILURE
        self._is_qos_checked = True
        settings = self._settings.settings()
        try:
            check_place(settings)
            if settings.bond_timeout:
                status_type(settings.bond_timeout)  # raises without it
        except ValueError as error:
            self.report(f"configure refused: {error}")
            return FAILURE
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
        if timeout_s := self._settings.settings().bond_timeout:
            self._bond = Bond(self, timeout_s)
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

    def _topic_problems(self, cameras: Sequence[str]) -> list[str]:
        """Problems of these cameras, to which others may be added, with their topics or QoS overrides."""
        problems = topic_problems(self, cameras)
        are_wrong = any(problem.setting == CAMERAS for problem in self._settings.problems)
        # Overrides are fixed, but the camera of one may be wrong now, or gone since an earlier configure.
        if not self._is_qos_checked and not are_wrong:
            with suppress(RuntimeError):  # of a name that ROS refuses, which is told already
                problems += map(str, qos_problems(self, cameras))
        return problems

    def _status(self) -> Status:
        self._resources.update()
        return self._resources.status(self.state_label, self._problem)

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
        bond, self._bond = self._bond, None
        if bond is not None:
            bond.close()
        if self._resources.deactivate():
            return
        self.report(
            f"inference did not end within {self._rest_timeout_s:g} s, so the node abandons the thread; the "
            "thread's memory stays in use"
        )
        if (count := self._resources.hanging_sessions) > MAX_ABANDONED_SESSIONS:
            told = f": inference hangs in {count} abandoned sessions, the limit is {MAX_ABANDONED_SESSIONS}"
            self._exit(EXIT_ABANDONED_SESSIONS, told)

    async def _change_state(self, request: Any, response: Any) -> Any:
        wanted, possible = request.transition, available_transitions(self)
        label = requested_label(wanted, possible)
        if label is None:
            asked = in_one_line(wanted.label[:100]) or wanted.id
            names = ", ".join(f"{row[1]} ({row[0]})" for row in possible) or "none"
            self.get_logger().warning(
                f"transition '{asked}' refused in state {self.state_label}. Possible now: {names}.",
                throttle_duration_sec=1.0,
            )
        elif label == "activate":
            response.success = await self._resources.load() and self.trigger_activate() is SUCCESS
        else:
            response.success = await self._trigger_at_rest(label)
        return response

    async def _trigger_at_rest(self, label: str) -> bool:
        """Trigger a transition once the frame in progress has ended or hangs; return its success."""
        before = self.state_label
        async with self._resources.between_frames():
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
        self._exit(EXIT_DEVICE_LOST, f" because the device is lost: {reason}")

    def _exit(self, code: int, why: str) -> None:
        self.report(f"exiting (code {code}){why}")
        self._diagnostics.publish()
        self.exit_code = code
