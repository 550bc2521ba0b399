"""Hostile requests to every service of the node."""

from __future__ import annotations

import importlib
import random
import re
from collections.abc import Callable, Iterable
from typing import Any

from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import ParameterValue
from support.detector_process import NODE

from soak.finding import Finding, number_of
from soak.subject import Subject
from yolov5_lifecycle.settings.settings import SETTINGS

_SERVICES = 12
"""5 of every lifecycle node, 7 of every node."""
_PATIENCE_S = 60.0
_BURST = 5
_REQUESTS_PER_LIFE = 200
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
        self.sent = 0
        self.unanswered: list[str] = []

    @property
    def services(self) -> int:
        return len(self._clients)

    def ask(self, fuzz: Fuzz, most: int = _BURST) -> None:
        """Send a burst of at most `most` requests and take the responses."""
        clients = fuzz.random.choices(self._clients, k=min(most, fuzz.random.randint(1, _BURST)))
        asked = [(client, client.call_async(fuzz.fill(client.srv_type.Request()))) for client in clients]
        self.sent += len(asked)
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

    def close(self) -> None:
        for client in self._clients:
            self._observer.destroy_client(client)


def answered_requests(subject: Subject, seeds: Iterable[int], per_seed: int) -> Finding:
    """Send `per_seed` requests for every seed; the node is reset to its initial parameters in between."""
    seeds = list(seeds)
    client = HostileClient(subject)
    for seed in seeds:
        fuzz = Fuzz(seed)
        end = client.sent + per_seed
        while client.sent < end:
            subject.reset()
            subject.bring_to(fuzz.random.choice(["unconfigured", "inactive", "active"]))
            life = min(end, client.sent + _REQUESTS_PER_LIFE)
            while client.sent < life:
                client.ask(fuzz, most=life - client.sent)
    subject.reset()
    client.close()
    escaped = subject.escaped
    return Finding(
        claim="every hostile request is answered",
        done=f"{client.sent} requests to {client.services} services, seeds {seeds}",
        result=f"{number_of('unanswered', client.unanswered)}, {number_of('exceptions', escaped)}",
        limit="0, 0",
        is_met=not client.unanswered and not escaped,
    )
