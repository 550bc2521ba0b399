"""Messages to the console that others send under the name of a detector."""

from __future__ import annotations

import random
from typing import Any

from lifecycle_msgs.msg import State, TransitionEvent
from rcl_interfaces.msg import Log
from support.console_process import ConsoleClient, Page, address, console_process
from support.detector_process import NODE
from support.spoofer import LATCHED, parameter_event
from vision_msgs.msg import LabelInfo, VisionClass

from soak.finding import Finding, number_of
from soak.subject import Subject, exceptions_in

_LENGTHS = (0, 100, 10_000, 20_000_000)
_COUNTS = (1, 100, 20_000)
_NAMES = (NODE, "/nobody", "", "/\u202e", "x" * 100_000)
_PARAMETERS = ("confidence_threshold", "cameras", "weights", "no such", "")
_SENT_TOGETHER = 20


class Spoofer:
    """Sends messages at random to topics that the console subscribes to.

    Not to /diagnostics: what is there under a name is shown, true or not, and the subject is judged by it.
    """

    def __init__(self, subject: Subject, seed: int) -> None:
        self._random = random.Random(seed)
        self._node = subject.observer
        self._publishers: dict[str, Any] = {}

    def send(self) -> None:
        topic, message = self._random.choice(
            [self._event, self._event, self._log, self._labels, self._transition]
        )()
        if topic not in self._publishers:
            self._publishers[topic] = self._node.create_publisher(type(message), topic, LATCHED)
        self._publishers[topic].publish(message)

    def close(self) -> None:
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    @property
    def _text(self) -> str:
        return self._random.choice(["x", "\u202e", "\n", "\u00e9"]) * self._random.choice(_LENGTHS)

    @property
    def _name(self) -> str:
        return self._random.choice(_NAMES)

    @property
    def _count(self) -> int:
        return self._random.choice(_COUNTS)

    def _event(self) -> tuple[str, Any]:
        value = self._random.choice([0.99, True, 7, self._text, [self._text, "../x"], ["a"] * self._count])
        message = parameter_event(self._name, self._random.choice(_PARAMETERS), value)
        if not isinstance(value, (str, list)):
            message.changed_parameters *= self._count
        return "/parameter_events", message

    def _log(self) -> tuple[str, Any]:
        name = self._name.removeprefix("/")
        return "/rosout", Log(name=name, msg=self._text, level=self._random.choice([0, 20, 40, 255]))

    def _labels(self) -> tuple[str, Any]:
        names = [VisionClass(class_name=self._text[:1000])] * self._count
        return f"{NODE}/label_info", LabelInfo(class_map=names)

    def _transition(self) -> tuple[str, Any]:
        return f"{NODE}/transition_event", TransitionEvent(goal_state=State(label=self._text))


def spoofed_console(subject: Subject, count: int, seed: int) -> Finding:
    """Send `count` messages; after every few, a page is served and is shown what the detector answers."""
    subject.reset()
    chooser, wrong = random.Random(seed), list[str]()
    with console_process(subject.domain) as console, ConsoleClient(address(console)).page() as page:
        page.wait_for(lambda: NODE in page.nodes, "the detector")
        spoofer = Spoofer(subject, seed)
        for number in range(count):
            spoofer.send()
            if number % _SENT_TOGETHER == _SENT_TOGETHER - 1 or number == count - 1:
                wrong += filter(None, [_problem(page, round(chooser.uniform(0.1, 0.9), 3))])
        spoofer.close()
        tracebacks = exceptions_in(console.output)
    return Finding(
        claim="what others send under a detector's name neither blocks the console nor deceives it",
        done=f"{count} spoofed messages",
        result=f"{number_of('pages not served or deceived', wrong)}, {len(tracebacks)} tracebacks",
        limit="0, 0",
        is_met=not wrong and not tracebacks,
    )


def _problem(page: Page, value: float) -> str:
    """What is wrong with the answer to a change, or with what is shown then, "" if nothing is."""
    try:
        if refusal := page.set(confidence_threshold=value):
            return refusal
        page.wait_for(lambda: page.parameter("confidence_threshold")["value"] == value, "the new value")
    except AssertionError as error:
        return str(error)
    cameras = [camera["name"] for camera in page.nodes[NODE]["cameras"]]
    return "" if cameras == [""] else f"the page shows the cameras {cameras}"
