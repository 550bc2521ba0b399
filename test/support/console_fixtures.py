"""A detector in this process and a console beside it, which the tests of one file share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header

from support.console_process import ConsoleClient, address, console_process
from support.preparations import Preparations
from support.served_node import ServedNode
from support.worker import worker_domain
from yolov5_lifecycle.ros.child_process import ChildProcess, isolated


@dataclass
class ConsoleBesideNode:
    """A served detector with models of the test's, and a console of the same domain."""

    served: ServedNode
    prepare: Preparations
    domain: int
    process: ChildProcess
    client: ConsoleClient


@contextmanager
def console_beside_node(*arguments: str, parameters: tuple[str, ...] = ()) -> Iterator[ConsoleBesideNode]:
    """A detector with `parameters` and a console that is given `arguments`."""
    prepare = Preparations()
    with worker_domain() as domain, pytest.MonkeyPatch.context() as environment:
        for name, value in isolated({}, domain).items():
            environment.setenv(name, value)
        with (
            ServedNode(prepare, parameters=parameters) as served,
            console_process(domain, *arguments) as process,
        ):
            yield ConsoleBesideNode(served, prepare, domain, process, ConsoleClient(address(process)))
            process.check_running()
            assert "Traceback" not in process.output
        assert served.escaped == []


class JpegPublisher:
    """Publishes compressed images as a detector does, numbered by their stamps in seconds."""

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._publisher = node.create_publisher(CompressedImage, topic, QoSProfile(depth=1))
        self.count = 0

    @property
    def subscribers(self) -> int:
        return int(self._publisher.get_subscription_count())

    def publish(self, size: int = 100) -> None:
        """The next image, of so many bytes."""
        self.count += 1
        header = Header()
        header.stamp.sec = self.count
        self._publisher.publish(CompressedImage(header=header, format="jpeg", data=bytes(size)))

    def close(self) -> None:
        self._node.destroy_publisher(self._publisher)
