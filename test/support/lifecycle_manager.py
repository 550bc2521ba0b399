"""What Nav2's lifecycle manager of Jazzy does with its nodes, written again for the tests.

After `nav2_lifecycle_manager/src/lifecycle_manager.cpp`, `nav2_util/src/lifecycle_service_client.cpp` and
`bondcpp/src/bond.cpp`: the same requests in the same order and the same messages on `bond`. Only its patience
is longer, for a busy machine: Nav2's waits 2 s for an answer of get_state and half of bond_timeout for a
bond. It works only while its `Observer` waits for something.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from enum import Enum

from bond.msg import Status
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.clock import Clock, ClockType

from yolov5_lifecycle.ros.observer import Observer, RemoteLifecycleNode

HEARTBEAT_S = 0.1
_DEAD_PUBLISH_S = 0.05
_EXPECTED = {
    Transition.TRANSITION_CONFIGURE: State.PRIMARY_STATE_INACTIVE,
    Transition.TRANSITION_CLEANUP: State.PRIMARY_STATE_UNCONFIGURED,
    Transition.TRANSITION_ACTIVATE: State.PRIMARY_STATE_ACTIVE,
    Transition.TRANSITION_DEACTIVATE: State.PRIMARY_STATE_INACTIVE,
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN: State.PRIMARY_STATE_FINALIZED,
}


class BondState(Enum):
    WAITING_FOR_SISTER = 1
    ALIVE = 2
    AWAIT_SISTER_DEATH = 3
    DEAD = 4


class ManagerBond:
    """The manager's side of the bond with one node; `heard` are the messages of the other side, in order."""

    def __init__(self, observer: Observer, node_name: str, timeout_s: float) -> None:
        self.state = BondState.WAITING_FOR_SISTER
        self.heard: list[Status] = []
        self.ended_by_timeout = False
        self._observer = observer
        self._node_name = node_name
        self._timeout_s = timeout_s
        self._instance_id = f"manager-{time.monotonic_ns()}"
        self._heard_s = float("inf")
        self._publisher = observer.create_publisher(Status, "/bond", 5)
        self._subscription = observer.create_subscription(Status, "/bond", self._take, 100)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timers = [
            observer.create_timer(HEARTBEAT_S, self._beat, clock=steady),
            observer.create_timer(_DEAD_PUBLISH_S, self._look, clock=steady),
        ]

    @property
    def is_broken(self) -> bool:
        return self.state is BondState.DEAD

    @property
    def is_formed(self) -> bool:
        return self.state is not BondState.WAITING_FOR_SISTER

    def break_bond(self) -> None:
        if not self.is_broken:
            is_alive = self.state is BondState.ALIVE
            self.state = BondState.AWAIT_SISTER_DEATH if is_alive else BondState.DEAD
            self._publish(is_active=False)

    def close(self) -> None:
        """As bondcpp's destructor: end the bond, wait a little for the other side, send no more."""
        self.break_bond()
        self.silence()

    def silence(self) -> None:
        """Vanish as a manager that is killed."""
        for timer in self._timers:
            self._observer.destroy_timer(timer)
        self._observer.destroy_subscription(self._subscription)
        self._observer.destroy_publisher(self._publisher)

    def _beat(self) -> None:
        if self.state in (BondState.WAITING_FOR_SISTER, BondState.ALIVE):
            self._publish(is_active=True)

    def _look(self) -> None:
        if self.state is BondState.AWAIT_SISTER_DEATH:
            self._publish(is_active=False)
        if self.state is BondState.ALIVE and time.monotonic() - self._heard_s > self._timeout_s:
            self.state, self.ended_by_timeout = BondState.DEAD, True

    def _take(self, message: Status) -> None:
        if message.id != self._node_name or message.instance_id == self._instance_id:
            return
        self.heard.append(message)
        if message.active:
            self._heard_s = time.monotonic()
            if self.state is BondState.WAITING_FOR_SISTER:
                self.state = BondState.ALIVE
        elif not self.is_broken:
            self.state = BondState.DEAD
            self._publish(is_active=False)

    def _publish(self, *, is_active: bool) -> None:
        message = Status(
            id=self._node_name,
            instance_id=self._instance_id,
            active=is_active,
            heartbeat_timeout=self._timeout_s,
            heartbeat_period=HEARTBEAT_S,
        )
        message.header.stamp = self._observer.get_clock().now().to_msg()
        self._publisher.publish(message)


class ManagerError(Exception):
    """What the manager logs as an error."""


class LifecycleManager:
    """Leads the nodes `node_names` of the root namespace as Nav2's manager does."""

    def __init__(
        self, observer: Observer, node_names: Sequence[str] = ("yolov5",), *, bond_timeout_s: float = 4.0
    ) -> None:
        self.bonds: dict[str, ManagerBond] = {}
        self._observer = observer
        self._node_names = list(node_names)
        self._bond_timeout_s = bond_timeout_s
        self._change_state = {
            name: observer.create_client(ChangeState, f"/{name}/change_state") for name in node_names
        }
        self._get_state = {
            name: observer.create_client(GetState, f"/{name}/get_state") for name in node_names
        }
        # A node that answers a client made later has discovered these, too; it would lose earlier answers.
        for name in node_names:
            RemoteLifecycleNode(observer, f"/{name}").wait_until_reachable()

    def startup(self) -> None:
        """Configure and activate all nodes in order; raises ManagerError at the first that is not so."""
        self._change_all(Transition.TRANSITION_CONFIGURE)
        self._change_all(Transition.TRANSITION_ACTIVATE)

    def pause(self) -> None:
        self._change_all(Transition.TRANSITION_DEACTIVATE)

    def resume(self) -> None:
        self._change_all(Transition.TRANSITION_ACTIVATE)

    def shutdown(self) -> None:
        """Deactivate, clean up and shut down all nodes, the last one first."""
        self._change_all(Transition.TRANSITION_DEACTIVATE)
        self._change_all(Transition.TRANSITION_CLEANUP)
        self._change_all(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)

    def _change_all(self, transition: int) -> None:
        is_upwards = transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
        for name in self._node_names if is_upwards else reversed(self._node_names):
            self._change(name, transition)

    def _change(self, name: str, transition: int) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        # Nav2 waits for this answer without a limit, does not look at it, and then asks for the state.
        self._observer.call(self._change_state[name], request)
        answer = self._observer.call(self._get_state[name], GetState.Request())
        if answer.current_state.id != _EXPECTED[transition]:
            raise ManagerError(f"failed to change state for node {name}: {answer.current_state.label}")
        if transition == Transition.TRANSITION_ACTIVATE:
            self._bond(name)
        elif transition == Transition.TRANSITION_DEACTIVATE and name in self.bonds:
            self.bonds.pop(name).close()

    def _bond(self, name: str) -> None:
        if not self._bond_timeout_s or name in self.bonds:
            return
        bond = self.bonds[name] = ManagerBond(self._observer, name, self._bond_timeout_s)
        self._observer.wait_for(lambda: bond.is_formed, f"the bond with {name}")
