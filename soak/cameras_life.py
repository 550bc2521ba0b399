"""Several cameras on one model, with random actions: some are steady, one is hostile."""

from __future__ import annotations

import time
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.srv import ListParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from support.detector_process import NODE, scene_image

from soak.finding import Finding, number_of
from soak.images import damaged_message, hostile_image, odd_image
from soak.service_requests import Fuzz
from soak.subject import Sender, Subject, camera

STEADY = ("front", "rear")
"""Cameras that never stop, and whose images must be detected whatever the others do."""
_OTHERS = ("left", "door")
_HOSTILE = "gate"
NAMES = (*STEADY, *_OTHERS, _HOSTILE)
_SENDING = (*STEADY, "left")  # nobody publishes for the door
RATE_HZ = 5.0
_OTHER_CAMERAS: tuple[list[str], ...] = (["front", "front"], ["front", ""], ["front", "a b"], ["front"], [])
_SIZES_HW = ((240, 320), (320, 240), (64, 640), (480, 480), (37, 501), (200, 320))
_HARMLESS: dict[str, tuple[Any, ...]] = {
    "confidence_threshold": (0.1, 0.25, 0.5),
    "iou_threshold": (0.3, 0.6),
    "max_detections": (5, 1000),
    "classes": (["circle"], ["0", "3"]),
    "class_thresholds": (["circle: 0.01", "1: 0.9"], []),
    "regions": (["0,0 1,0 1,1 0,1", "0.2,0.2 0.8,0.3 0.5,0.9"], []),
    "ignore_regions": (["0,0 0.2,0 0.2,1 0,1"], []),
    "region_anchor": ("center", "foot"),
    "min_box_size": (0.0, 0.05),
    "agnostic_nms": (True, False),
    "tracker": ("none", "bytetrack"),
    "track_timeout": (0.5, 1.0),
    "track_high_threshold": (0.2, 0.5),
    "track_low_threshold": (0.05, 0.3),
}
"""Overrides that cost a camera no frame; the last one may contradict the one before it."""
_DISTURBING: dict[str, tuple[Any, ...]] = {
    "max_rate": (0.0, 2.0),
    "lazy": (True, False),
    "depth": (True, False),
    "depth_slop_s": (0.0, 0.1),
    "image_reliability": ("auto", "best_effort", "reliable"),
    "image_transport": ("raw", "compressed"),
    "no_such_setting": (1,),
    "max_rates": (1.0,),
}
_CHECK_EVERY = 20
_MIN_SHARE = 0.95
_MAX_GROWTH_MB = 20.0
_WARM_UP = 4
"""Memory growth is measured against the first of this many equal parts of the checks."""
_BAD_VALUES = (-1, 2.5, "x", True, ["circle"], [1, 2])


class CamerasLife:
    """One active subject with several cameras, and all actions on it. A context manager."""

    def __init__(self, subject: Subject, seed: int) -> None:
        self._subject = subject
        self._fuzz = Fuzz(seed)
        self._choose: Callable[[Any], Any] = self._fuzz.random.choice
        self._lists = subject.observer.create_client(ListParameters, f"{NODE}/list_parameters")
        self._processes = ExitStack()
        self._overrides: set[str] = set()
        self.problems: list[str] = []
        self.clients: dict[str, Sender] = {}
        self.done: Counter[str] = Counter()
        self._actions: dict[str, tuple[int, Callable[[], object]]] = {
            "refused cameras": (2, self._set_other_cameras),
            "overrides": (10, self._override),
            "bad overrides": (3, self._set_bad_override),
            "deleted overrides": (6, self._inherit),
            "trackers": (2, self._change_tracker),
            "reloads": (1, self._reload),
            "depth images": (6, self._send_depth),
            "placing": (2, self._place),
            "hostile images": (8, self._send_hostile),
            "other sizes": (4, self._send_other_sizes),
            "floods": (2, self._flood),
            "pauses": (6, lambda: subject.observer.work_for(self._fuzz.random.uniform(0, 1.0))),
        }

    def __enter__(self) -> CamerasLife:
        self._subject.reset()
        self._set(cameras=NAMES, tracker="bytetrack")
        self._subject.bring_to("active")
        self.clients |= {name: Sender(self._subject, name=name) for name in NAMES}
        for name in _SENDING:
            topic = f"{NODE}/{name}/image_raw"
            process = camera(self._subject.domain, topic, rate=RATE_HZ, width=320, height=240)
            self._processes.enter_context(process)
        for name in _SENDING:
            self._subject.observer.wait_for(
                lambda: self.clients[name].heard > 0,  # noqa: B023
                f"detections of {name}",
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._processes.close()
        for client in self.clients.values():
            client.close()

    @property
    def kinds(self) -> list[str]:
        """All kinds of actions."""
        return [*self._actions]

    def random_kinds(self, count: int) -> list[str]:
        """Kinds of the next actions, drawn by their frequency."""
        weights = [weight for weight, _ in self._actions.values()]
        return self._fuzz.random.choices(self.kinds, weights, k=count)

    def act(self, kind: str) -> None:
        """Perform one action, with random values."""
        self._actions[kind][1]()
        self.done[kind] += 1

    def check(self) -> None:
        """Compare status and parameters with the present cameras, and detect with the hostile one."""
        self._compare("status", {*self._subject.statuses()} - {""}, {*NAMES})
        self._compare("parameters", self._declared_overrides(), self._overrides)
        self._inherit_all(_HOSTILE)
        self.clients[_HOSTILE].send_whole()

    def _compare(self, what: str, found: Collection[str], expected: Collection[str]) -> None:
        if {*found} != {*expected}:
            self.problems.append(f"{what}: {sorted(found)} instead of {sorted(expected)}")

    def _declared_overrides(self) -> list[str]:
        listed = self._subject.observer.call(self._lists, ListParameters.Request(prefixes=[*NAMES]))
        return list(listed.result.names)

    def _set(self, **values: object) -> None:
        if refusal := self._subject.node.set_parameters(**values):
            self.problems.append(f"{values} was refused: {refusal}")

    def _set_other_cameras(self) -> None:
        self._expect_refusal(cameras=self._choose(_OTHER_CAMERAS))

    def _override(self) -> None:
        """Set a random override: only contradictions and unknown settings may be refused."""
        name = self._choose([*NAMES])
        table = _HARMLESS if name in STEADY else _HARMLESS | _DISTURBING
        setting = self._choose([*table])
        value = self._choose(table[setting])
        refusal = self._subject.node.set_parameters(**{f"{name}.{setting}": value})
        if not refusal:
            self._overrides.add(f"{name}.{setting}")
        elif setting not in ("track_high_threshold", "track_low_threshold", "no_such_setting", "max_rates"):
            self.problems.append(f"{name}.{setting} = {value} was refused: {refusal}")

    def _set_bad_override(self) -> None:
        name = self._choose([*NAMES])
        self._expect_refusal(**{f"{name}.track_match_threshold": self._choose(_BAD_VALUES)})
        self._expect_refusal(**{"nobody.max_rate": 1.0})

    def _expect_refusal(self, **values: object) -> None:
        if not self._subject.node.set_parameters(**values):
            self.problems.append(f"{values} was accepted")

    def _inherit(self) -> None:
        if self._overrides:
            self._delete(self._choose(sorted(self._overrides)))

    def _delete(self, name: str) -> None:
        """Delete like `ros2 param delete`; refused if the inherited value would contradict others."""
        message = Parameter(name, Parameter.Type.NOT_SET).to_parameter_msg()
        (result,) = self._subject.set_one_by_one([message])
        if result.successful:
            self._overrides.discard(name)
        elif "threshold" not in name:
            self.problems.append(f"{name} was not deleted: {result.reason}")

    def _inherit_all(self, camera_name: str) -> None:
        for name in sorted(self._overrides):
            if name.startswith(f"{camera_name}."):
                self._delete(name)

    def _change_tracker(self) -> None:
        self._set(tracker=self._choose(["none", "bytetrack"]))

    def _reload(self) -> None:
        self._set(image_size=256 if self._subject.node.parameter("image_size") == 320 else 320)

    def _send_depth(self) -> None:
        for _ in range(5):
            for name in NAMES:
                self.clients[name].send_depth()
            self._subject.observer.work_for(0.05)

    def _place(self) -> None:
        """Send depth for a camera with images until a detection is placed in space."""
        name = "left"
        self._inherit_all(name)
        values = {f"{name}.depth": True, f"{name}.depth_slop_s": 0.1}
        self._set(**values)
        self._overrides |= values.keys()
        client = self.clients[name]
        heard = client.heard_3d

        def is_placed() -> bool:
            client.send_depth()
            return client.heard_3d > heard

        self._subject.observer.wait_for(is_placed, "detections in space")

    def _send_hostile(self) -> None:
        for make in (hostile_image, damaged_message, odd_image):
            self.clients[_HOSTILE].send(make(self._fuzz))
            self._subject.observer.work_for(0.02)

    def _send_other_sizes(self) -> None:
        for _ in range(3):
            self.clients[_HOSTILE].send(grey_image(self._choose(_SIZES_HW)))
            self._subject.observer.work_for(0.1)

    def _flood(self) -> None:
        image = scene_image()
        for _ in range(300):
            self.clients[_HOSTILE].send(image)


def grey_image(size_hw: tuple[int, int]) -> Image:
    """A readable image of any size, without content."""
    height, width = size_hw
    data = array("B", bytes(3 * height * width))
    return Image(height=height, width=width, step=3 * width, encoding="bgr8", data=data)


@dataclass(frozen=True)
class _Outcome:
    """`share` of the images of the steady cameras that were detected; `resident_mb` at each check."""

    taken_s: float
    share: float
    resident_mb: Sequence[float]

    @property
    def growth_mb(self) -> float:
        warm = len(self.resident_mb) // _WARM_UP
        return max(self.resident_mb[-warm - 1 :]) - max(self.resident_mb[: warm + 1])


def several_cameras(subject: Subject, seed: int, minutes: float, *, is_judged: bool = True) -> Finding:
    """Do every action once, then random ones for `minutes`; share and memory count only if `is_judged`."""
    with CamerasLife(subject, seed) as life:
        outcome = _outcome(subject, life, minutes)
    subject.reset()
    escaped = subject.escaped
    problems = [*life.problems, *subject.balance.problems]
    are_fine = outcome.share >= _MIN_SHARE and outcome.growth_mb < _MAX_GROWTH_MB
    return Finding(
        claim="cameras that misbehave disturb neither the others nor the process",
        done=f"{life.done.total()} actions of {len(life.done)} kinds on {len(NAMES)} cameras in "
        f"{outcome.taken_s / 60:.0f} minutes, "
        f"{sum(client.heard_3d for client in life.clients.values())} images with depth, seed {seed}",
        result=f"{number_of('wrong answers or counts', problems)}, "
        f"{number_of('exceptions', escaped)}; {outcome.share:.1%} of the images of the steady cameras "
        f"({RATE_HZ:g} Hz) detected; RSS {outcome.growth_mb:+.1f} MB",
        limit=f"0, 0; {f'{_MIN_SHARE:.0%}; < {_MAX_GROWTH_MB:+g} MB' if is_judged else 'not judged'}",
        is_met=not problems and not escaped and (are_fine or not is_judged),
    )


def _outcome(subject: Subject, life: CamerasLife, minutes: float) -> _Outcome:
    begun_s, before = time.monotonic(), _steady_counts(subject)
    resident_mb: list[float] = []
    kinds = life.kinds
    while not resident_mb or time.monotonic() < begun_s + 60 * minutes:
        for kind in kinds:
            life.act(kind)
        life.check()
        kinds = life.random_kinds(_CHECK_EVERY)
        resident_mb.append(subject.resources().resident_mb)
    taken_s = time.monotonic() - begun_s
    return _Outcome(taken_s, _min_share(before, _steady_counts(subject)), resident_mb)


def _steady_counts(subject: Subject) -> dict[str, Counter[str]]:
    """Images of the steady cameras so far, by outcome."""
    statuses = subject.statuses()
    return {
        name: Counter({key: int(value) for key, value in statuses[name].items() if key.startswith("frames ")})
        for name in STEADY
    }


def _min_share(before: Mapping[str, Counter[str]], after: Mapping[str, Counter[str]]) -> float:
    """The smallest share of the images sent that was detected."""
    counts = [after[name] - before[name] for name in STEADY]
    sent = ("frames received", "frames lost", "frames overtaken")
    return min(count["frames detected"] / sum(count[key] for key in sent) for count in counts)
