"""The loop that serves a node's callbacks."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from yolov5_lifecycle.ros.nodes import spin
from yolov5_lifecycle.ros.rclpy_internals import ResilientExecutor


@pytest.fixture
def node(ros_domain: int) -> Iterator[Node]:
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    yield rclpy.create_node("spun", context=context)
    rclpy.try_shutdown(context=context)


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


def test_the_loop_ends_when_somebody_else_shuts_ros_down(
    node: Node, executor: SingleThreadedExecutor
) -> None:
    node.create_timer(0.01, lambda: rclpy.shutdown(context=node.context))
    spin(executor, node, until=lambda: False)
    assert not node.context.ok()
