"""The real node over the real middleware in this process, with a runtime of the test's, and a client."""

from __future__ import annotations

import gc
import os
import threading
from array import array
from collections.abc import Callable, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Log
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from vision_msgs.msg import Detection2DArray, LabelInfo

from yolov5_lifecycle.detection.prepared_model import Prepare
from yolov5_lifecycle.ros.detector.node import DetectorNode
from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S
from yolov5_lifecycle.ros.detector.transforms import Tf2, Transforms
from yolov5_lifecycle.ros.observer import PATIENCE_S, Observer

_SERVICES = {
    "collect": Trigger,
    "change_state": ChangeState,
    "get_state": GetState,
    "describe_parameters": DescribeParameters,
    "get_parameter_types": GetParameterTypes,
    "get_parameters": GetParameters,
    "list_parameters": ListParameters,
    "set_parameters": SetParameters,
    "set_parameters_atomically": SetParametersAtomically,
}


class ServedNode:
    """A `DetectorNode` spun in a thread, and what a client needs to try it; a context manager.

    At its end, no exception may have escaped from a callback of the node.
    """

    def __init__(
        self,
        prepare: Prepare,
        *,
        parameters: Sequence[str] = (),
        arguments: Sequence[str] = (),
        rest_timeout_s: float = REST_TIMEOUT_S,
        listen: Callable[[Node], Transforms] = Tf2,
    ) -> None:
        """`parameters` are `name:=value`; `arguments` are further words of the command line."""
        # A node of an earlier test, still in a reference cycle, would keep the publisher of /rosout, which
        # rcl registers by node name: https://github.com/ros2/rcl/blob/jazzy/rcl/src/rcl/logging_rosout.c
        gc.collect()
        self.client = Observer("client", domain=int(os.environ["ROS_DOMAIN_ID"]))
        assignments = [word for parameter in parameters for word in ("-p", parameter)]
        words = [*arguments, *(["--ros-args", *assignments] if assignments else [])]
        self.node = DetectorNode(
            prepare=prepare,
            rest_timeout_s=rest_timeout_s,
            listen=listen,
            diagnostics_period_s=0.1,
            context=self.client.context,
            cli_args=words,
        )
        self._executor = SingleThreadedExecutor(context=self.client.context)
        self._executor.add_node(self.node)
        self._stopping = False
        self._thread = threading.Thread(target=self._serve)
        self.escaped: list[Exception] = []
        self.detections: list[Detection2DArray] = []
        self.diagnostics: list[DiagnosticArray] = []
        self.log: list[str] = []
        self._sent = 0
        # Made before the node is served: endpoints of one participant that two threads make at the same time
        # do not always find each other.
        self._services = {
            name: self.client.create_client(service_type, f"{self.node.get_fully_qualified_name()}/{name}")
            for name, service_type in _SERVICES.items()
        }
        self.images = self.client.create_publisher(Image, "/yolov5/image_raw", 1)
        self._of_detections = self.client.create_subscription(
            Detection2DArray, "/yolov5/detections", self.detections.append, 10
        )
        self.client.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, 10)
        kept = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.client.create_subscription(Log, "/rosout", lambda message: self.log.append(message.msg), kept)

    def __enter__(self) -> ServedNode:
        self._thread.start()
        return self

    def __exit__(self, raised: type[BaseException] | None, *_: object) -> None:
        self._stopping = True
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive(), "a callback of the node hangs: destroying the node would crash"
        self.node.close()
        self._executor.shutdown()  # else the garbage collector does, and raises if it takes its parts first
        self.client.close()
        assert raised or self.escaped == []

    def _serve(self) -> None:
        while not self._stopping:
            self._serve_once()

    def _serve_once(self) -> None:
        try:
            self._executor.spin_once(timeout_sec=0.05)
        except Exception as error:  # noqa: BLE001 - whatever escapes is what the tests look for
            self.escaped.append(error)

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        """Spin the client until `condition`, or fail after a while."""
        self.client.wait_for(condition, what)

    def wait_for_log(self, text: str) -> None:
        """Wait until the node has said `text`."""
        self.wait_for(lambda: any(text in said for said in self.log), f"the word {text!r} in the log")

    def begin(self, service: str, request: Any) -> Any:
        """Send a request; the future of its response."""
        client = self._services[service]
        self.wait_for(client.service_is_ready, f"the service {service}")
        return client.call_async(request)

    def call(self, service: str, request: Any) -> Any:
        return self.client.call(self._services[service], request)

    def begin_transition(self, label: str) -> Any:
        return self.begin("change_state", ChangeState.Request(transition=Transition(label=label)))

    def transition(self, label: str, transition_id: int = 0) -> bool:
        transition = Transition(id=transition_id, label=label)
        return bool(self.call("change_state", ChangeState.Request(transition=transition)).success)

    def bring_to(self, state: str) -> None:
        """Walk from unconfigured to `state`."""
        path = {"inactive": ["configure"], "active": ["configure", "activate"], "finalized": ["shutdown"]}
        for label in path.get(state, []):
            assert self.transition(label), label
        assert self.state() == state

    def state(self) -> str:
        return str(self.call("get_state", GetState.Request()).current_state.label)

    def begin_set(self, **values: Any) -> Any:
        request = SetParametersAtomically.Request(parameters=messages_of(**values))
        return self.begin("set_parameters_atomically", request)

    def set(self, **values: Any) -> tuple[bool, str]:
        """Set all together; whether it was done, and the reason if not."""
        return self.set_messages(messages_of(**values))

    def refusal(self, **values: Any) -> str:
        """Set all together; the reason why that was not done."""
        done, reason = self.set(**values)
        assert not done
        return reason

    def set_messages(self, messages: Sequence[Any]) -> tuple[bool, str]:
        """Like `set`, with parameters as they are sent."""
        request = SetParametersAtomically.Request(parameters=list(messages))
        result = self.call("set_parameters_atomically", request).result
        return result.successful, result.reason

    def set_one_by_one(self, messages: Sequence[Any]) -> list[Any]:
        request = SetParameters.Request(parameters=list(messages))
        return list(self.call("set_parameters", request).results)

    def get(self, name: str) -> Any:
        (value,) = self.call("get_parameters", GetParameters.Request(names=[name])).values
        return Parameter.from_parameter_msg(ParameterMessage(name=name, value=value)).value

    def image_subscriptions(self) -> int:
        """How many are in the ROS graph; the count of a publisher misses some that leave at the same time."""
        return int(self.client.count_subscribers("/yolov5/image_raw"))

    def ignore_detections(self) -> None:
        """Subscribe to detections no longer."""
        self.client.destroy_subscription(self._of_detections)

    def publish(self, message: Image | None = None) -> None:
        """Send one image once the node listens."""
        self.wait_for(lambda: self.images.get_subscription_count() > 0, "the node to subscribe")
        self.images.publish(message or image())

    def send_until(self, condition: Callable[[], bool], what: str) -> None:
        """Send images, numbered by their stamps, until `condition`, or fail after a while."""

        def is_done() -> bool:
            self._sent += 1
            message = image()
            message.header.stamp.sec = self._sent
            self.images.publish(message)
            return condition()

        self.wait_for(is_done, what)

    def detect(self) -> Detection2DArray:
        """Send images until one of them is detected; what was found in it."""
        before = self._sent

        def is_detected() -> bool:
            return bool(self.detections) and self.detections[-1].header.stamp.sec > before

        self.send_until(is_detected, "a detection")
        return self.detections[-1]

    def received(self, messages: Sequence[Any], header: Header, what: str) -> Any:
        """The only one of the messages received by and by that has this header."""
        self.wait_for(lambda: any(message.header == header for message in messages), what)
        (found,) = [message for message in messages if message.header == header]
        return found

    def label_info(self) -> LabelInfo:
        """What a late subscriber to the latched topic gets."""
        received: list[LabelInfo] = []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        subscription = self.client.create_subscription(
            LabelInfo, "/yolov5/label_info", received.append, latched
        )
        self.wait_for(lambda: bool(received), "label_info")
        self.client.destroy_subscription(subscription)
        return received[-1]

    def status(self, camera: str = "detection") -> Any:
        """The next diagnostic status of the node or a camera, made after this call."""
        return self.statuses()[camera]

    def statuses(self) -> dict[str, Any]:
        """The next diagnostic statuses, of the node and its cameras, by name."""
        asked = self.client.get_clock().now()

        def is_answered() -> bool:
            return bool(self.diagnostics) and Time.from_msg(self.diagnostics[-1].header.stamp) > asked

        self.wait_for(is_answered, "diagnostics")
        return {status.name.rpartition(": ")[2]: status for status in self.diagnostics[-1].status}

    def values(self, camera: str = "detection") -> dict[str, str]:
        """The values of the next diagnostic status."""
        return {item.key: item.value for item in self.status(camera).values}

    def counts(self, camera: str = "detection") -> dict[str, int]:
        """Frames by what became of them, from the next diagnostic status."""
        prefix = "frames "
        return {
            key.removeprefix(prefix): int(value)
            for key, value in self.values(camera).items()
            if key.startswith(prefix) and key not in ("frames lost", "frames overtaken")
        }


def image(height: int = 48, width: int = 64, encoding: str = "rgb8") -> Image:
    """A grey image."""
    message = Image(height=height, width=width, encoding=encoding, step=width * 3)
    message.data = array("B", bytes([114]) * (height * width * 3))
    return message


def messages_of(**values: Any) -> list[Any]:
    """Parameters as a request has them."""
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]


def class_ids_of(detections: Detection2DArray) -> list[str]:
    return [detection.results[0].hypothesis.class_id for detection in detections.detections]
