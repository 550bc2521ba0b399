"""Messages that nobody means: requests to every service of the node, odd, damaged and faulty images."""

from __future__ import annotations

import importlib
import random
import re
from array import array
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import ParameterValue
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from support.detector_process import NODE

from soak.faulty_detector import GREYS
from soak.subject import Subject
from yolov5_lifecycle.images.encodings import ENCODINGS
from yolov5_lifecycle.images.image import MAX_FRAME_ID, MAX_SIDE_PX
from yolov5_lifecycle.settings.settings import SETTINGS

_SERVICES = 12
"""5 of every lifecycle node, 7 of every node."""
_PATIENCE_S = 60.0
_BURST = 5
_HUGE_ODDS = 0.01
_MEGABYTE = 1_000_000
_TEXTS = (
    "", " ", "cpu", "circle", "n", "compressed", "configure", "activate", "deactivate", "cleanup", "/yolov5",
    "../../etc/passwd", "package://", "%s%n%x", "a\nb", "\x1b[2J", "ünïcødé \U0001f600", "1e999", ".", "a..b",
)  # fmt: skip
_NAMES = (*(setting.name for setting in SETTINGS), "use_sim_time", "start_type_description_service")
_INTEGERS = (0, 1, -1, 2, 42, 320, 417, 2**31, 2**63 - 1, -(2**63))
_DOUBLES = (0.0, -0.0, 0.5, 1.0, -1.0, 1e-320, 1e308, float("nan"), float("inf"), float("-inf"))
_INTEGER_TYPE = re.compile(r"(u?)int(\d+)")
_ODD_SIZES_HW = ((1, 1), (1, MAX_SIDE_PX), (MAX_SIDE_PX, 1), (2, 3), (3, 4001), (1999, 5))
_SHUTDOWNS = {
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
    Transition.TRANSITION_INACTIVE_SHUTDOWN,
    Transition.TRANSITION_ACTIVE_SHUTDOWN,
}


class Fuzz:
    """Messages of any type with random content; shutdown is never requested."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)

    def fill(self, message: Any) -> Any:
        """`message` with every field replaced by random values."""
        for name, field_type in message.get_fields_and_field_types().items():
            setattr(message, name, self._value(field_type))
        if isinstance(message, ParameterValue) and self.random.random() < 0.9:
            message.type = self.random.choice([*range(10), 42])
        if isinstance(message, Transition) and message.id in _SHUTDOWNS:
            message.id = 42
        return message

    def _value(self, field_type: str) -> Any:
        if field_type.startswith("sequence<"):
            return self._sequence(field_type.removeprefix("sequence<").removesuffix(">"))
        if "/" in field_type:
            return self.fill(message_type(field_type, "msg")())
        if integer := _INTEGER_TYPE.fullmatch(field_type):
            return self._integer(*integer.groups())
        choose: dict[str, Callable[[], Any]] = {
            "string": self._text,
            "boolean": lambda: self.random.random() < 0.5,
            "octet": lambda: self.random.randbytes(1),
            "double": lambda: self.random.choice([*_DOUBLES, self.random.uniform(-2, 2)]),
        }
        return choose[field_type]()

    def _sequence(self, item_type: str) -> list[Any]:
        if "/" not in item_type and self.random.random() < _HUGE_ODDS:
            return [self._value(item_type)] * 100_000 if item_type != "string" else ["x"] * 10_000
        return [self._value(item_type) for _ in range(self.random.choice([0, 1, 1, 2, 5]))]

    def _integer(self, unsigned: str, bits: str) -> int:
        least, most = (
            (0, 2 ** int(bits) - 1) if unsigned else (-(2 ** (int(bits) - 1)), 2 ** (int(bits) - 1) - 1)
        )
        known = [number for number in _INTEGERS if least <= number <= most]
        return self.random.choice([*known, self.random.randint(least, most)])

    def _text(self) -> str:
        if self.random.random() < _HUGE_ODDS:
            return self.random.choice("x/~.") * _MEGABYTE
        letters = "".join(map(chr, self.random.choices(range(1, 0x300), k=self.random.randrange(20))))
        return self.random.choice([*_NAMES, *_TEXTS, letters])


def message_type(name: str, kind: str) -> Any:
    """The class of `rcl_interfaces/Parameter` or `rcl_interfaces/srv/SetParameters`, for example."""
    return getattr(importlib.import_module(f"{name.split('/')[0]}.{kind}"), name.rpartition("/")[2])


class HostileClient:
    """Client for every service that the node offers."""

    def __init__(self, subject: Subject) -> None:
        self._observer = subject.observer
        self._observer.wait_for(lambda: len(self._offers()) >= _SERVICES, "all services of the node")
        self._clients = [
            self._observer.create_client(message_type(service_type, "srv"), service)
            for service, (service_type, *_) in self._offers()
        ]
        for client in self._clients:
            self._observer.wait_for(client.service_is_ready, client.srv_name)
        self.unanswered: list[str] = []

    def ask(self, fuzz: Fuzz) -> None:
        """Send a burst of requests and take the responses."""
        clients = fuzz.random.choices(self._clients, k=fuzz.random.randint(1, _BURST))
        asked = [(client, client.call_async(fuzz.fill(client.srv_type.Request()))) for client in clients]
        self.unanswered += [client.srv_name for client, future in asked if not self._is_answered(future)]

    def _offers(self) -> list[tuple[str, list[str]]]:
        """Name and types of every service of the node discovered so far."""
        offers = self._observer.get_service_names_and_types()
        return [offer for offer in offers if offer[0].startswith(f"{NODE}/")]

    def _is_answered(self, future: Any) -> bool:
        try:
            self._observer.wait_for(future.done, "an answer", timeout_s=_PATIENCE_S)
        except TimeoutError:
            return False
        return True


def odd_image(fuzz: Fuzz) -> Image:
    """A readable raw image with a shape and header that no camera sends."""
    height, width = fuzz.random.choice(_ODD_SIZES_HW)
    message = Image(height=height, width=width, step=3 * width, encoding="bgr8")
    fuzz.fill(message.header)
    message.header.frame_id = message.header.frame_id[:MAX_FRAME_ID]
    message.data = array("B", fuzz.random.randbytes(3 * width) * height)
    return message


def damaged_message(fuzz: Fuzz) -> bytes:
    """A small serialized raw image with wrong or missing bytes."""
    random, side = fuzz.random, 8
    encoding, layout = random.choice([*ENCODINGS.items()])
    step = side * layout.pixel_bytes
    message = Image(height=side, width=side, step=step, encoding=encoding)
    message.data = array("B", bytes(int(side * layout.rows) * step))
    data = bytearray(serialize_message(message))
    for _ in range(random.randint(1, 20)):
        data[random.randrange(len(data))] = random.randrange(256)
    return bytes(data[: random.choice([len(data), random.randrange(len(data))])])


def faulty_image(kind: str) -> Image:
    """An image that makes inference of the subject fail."""
    side = 320
    data = array("B", bytes([GREYS[kind]]) * (3 * side**2))
    return Image(height=side, width=side, encoding="rgb8", step=3 * side, data=data)
