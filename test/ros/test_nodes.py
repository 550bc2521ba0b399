"""What every node has: a loop that goes on whatever callbacks raise, and a word about its namesakes."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import closing

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger
from support.lone_node import lone_node
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.nodes import spin
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.ros.rclpy_internals import ResilientExecutor


@pytest.fixture
def node(ros_domain: int) -> Iterator[Node]:
    with lone_node("spun") as node:
        yield node


@pytest.fixture
def executor(node: Node) -> Iterator[SingleThreadedExecutor]:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    yield executor
    executor.shutdown()  # else the garbage collector does, and raises if it takes its parts first


def test_what_one_callback_raises_does_not_keep_the_others_from_being_served(
    node: Node, executor: SingleThreadedExecutor
) -> None:
    raised, served = [], []

    def fail() -> None:
        raised.append(1)
        raise ValueError("no good")

    node.create_timer(0.01, fail)
    node.create_timer(0.01, lambda: served.append(1))
    spin(executor, node, until=lambda: len(raised) > 2 and len(served) > 2)


def test_a_request_that_cannot_be_taken_is_dropped_and_the_next_one_is_answered(node: Node) -> None:
    executor = ResilientExecutor(context=node.context)
    executor.add_node(node)
    service = node.create_service(Trigger, "asked", lambda request, response: response)
    client = node.create_client(Trigger, "asked")
    service.srv_type = None
    answer = client.call_async(Trigger.Request())
    spin(executor, node, until=lambda: executor.dropped > 0)
    assert not answer.done()
    service.srv_type = Trigger
    answer = client.call_async(Trigger.Request())
    spin(executor, node, until=answer.done)
    executor.shutdown()


def test_the_loop_ends_when_another_part_shuts_ros_down(node: Node, executor: SingleThreadedExecutor) -> None:
    node.create_timer(0.01, lambda: rclpy.shutdown(context=node.context))
    spin(executor, node, until=lambda: False)
    assert not node.context.ok()


def test_a_detector_warns_in_any_state_while_other_nodes_have_its_name(ros_domain: int) -> None:
    own = f"/yolov5: this one (host {socket.gethostname()}, process {os.getpid()}) and"
    with (
        ServedNode(Preparations()) as served,
        lone_node("yolov5", "--ros-args", "-r", "__ns:=/robot"),  # whose name is another
    ):
        assert "nodes in this domain" not in served.status().message
        with closing(Observer("yolov5", domain=ros_domain)):
            served.wait_for_log(f"2 nodes in this domain are named {own} another. Requests")
            assert served.status().level == DiagnosticStatus.WARN
            with closing(Observer("yolov5", domain=ros_domain)):
                served.wait_for(lambda: f"{own} 2 others. Requests" in served.status().message, "both")
        served.wait_for(lambda: "nodes in this domain" not in served.status().message, "the others to leave")
