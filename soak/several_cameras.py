"""Several cameras on one model: some always there, some that come and go, one hostile."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import ExitStack
from typing import Any

from rclpy.parameter import Parameter
from support.detector_process import NODE, scene_image

from soak.camera_client import CameraClient, grey_image
from soak.finding import Finding, number_of
from soak.hostile_images import damaged_message, hostile_image, odd_image
from soak.service_requests import Fuzz
from soak.subject import Subject, camera
from soak.track_ids import TrackIds

STEADY = ("front", "rear")
"""Cameras that never stop; their rate is judged."""
_COMING = ("left", "door")
_HOSTILE = "gate"
_NAMES = (*STEADY, *_COMING, _HOSTILE)
_SENDING = (*STEADY, "left")  # nobody publishes for the door
_RATE_HZ = 10.0
_MIN_RATE = 0.95
_MAX_GROWTH_MB = 20.0
_WARM_UP = 4
"""The memory after this part of all checks, one of so many, is what it may grow from."""
_CHECK_EVERY = 20
_BAD_CAMERAS = (["front", "front"], ["front", ""], ["front", "a b"], ["front", "/rear"], ["front", "1st"])
_SIZES_HW = ((240, 320), (320, 240), (64, 640), (480, 480), (37, 501), (200, 320))
_HARMLESS: dict[str, tuple[Any, ...]] = {
    "confidence_threshold": (0.1, 0.25, 0.5),
    "iou_threshold": (0.3, 0.6),
    "max_detections": (5, 1000),
    "classes": (["circle"], ["0", "3"]),
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
_BAD_VALUES = (-1, 2.5, "x", True, ["circle"], [1, 2])


class CamerasLife:
    """One active subject with several cameras, and all actions on it. A context manager."""

    def __init__(self, subject: Subject, seed: int) -> None:
        self._subject = subject
        self._fuzz = Fuzz(seed)
        self._choose: Callable[[Any], Any] = self._fuzz.random.choice
        self._processes = ExitStack()
        self._present: Collection[str] = ()
        self._overrides: set[str] = set()
        self.problems: list[str] = []
        self.track_ids = TrackIds()
        self.clients = {name: CameraClient(subject, name, self.track_ids) for name in _NAMES}
        self.done: Counter[str] = Counter()
        self._actions: dict[str, tuple[int, Callable[[], object]]] = {
            "cameras": (3, self._change_cameras),
            "refused cameras": (2, self._set_bad_cameras),
            "overrides": (10, self._override),
            "bad overrides": (3, self._set_bad_override),
            "deleted overrides": (6, self._inherit),
            "trackers": (2, self._change_tracker),
            "reloads": (1, self._reload),
            "depth images": (6, self._send_depth),
            "hostile images": (8, self._send_hostile),
            "other sizes": (4, self._send_other_sizes),
            "floods": (2, self._flood),
            "pauses": (6, lambda: subject.observer.work_for(self._fuzz.random.uniform(0, 1.0))),
        }

    def __enter__(self) -> CamerasLife:
        self._subject.reset()
        self._set(cameras=_NAMES, tracker="bytetrack")
        self._present = _NAMES
        self._subject.bring_to("active")
        for name in _SENDING:
            topic = f"{NODE}/{name}/image_raw"
            process = camera(self._subject.domain, topic, rate=_RATE_HZ, width=320, height=240)
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

    def act(self) -> None:
        """Perform one random action."""
        weights = [weight for weight, _ in self._actions.values()]
        (kind,) = self._fuzz.random.choices(list(self._actions), weights)
        self._actions[kind][1]()
        self.done[kind] += 1

    def check(self) -> None:
        """The steady cameras and the hostile one are detected, and the status is of all that are there."""
        names = {*self._subject.statuses()} - {""}
        if names != {*self._present}:
            self.problems.append(f"status of {sorted(names)} instead of {sorted(self._present)}")
        if _HOSTILE not in self._present:
            self._set_cameras([*self._present, _HOSTILE])
        for name in self._overrides_of(_HOSTILE):
            self._delete(name)
        self.clients[_HOSTILE].detect()

    def _set(self, **values: object) -> None:
        if refusal := self._subject.node.set_parameters(**values):
            self.problems.append(f"{values} was refused: {refusal}")

    def _set_cameras(self, names: Collection[str]) -> None:
        """The cameras in `names`; the diagnostics have told of those that were removed when it returns."""
        begun_ns = time.time_ns()
        self._set(cameras=[*names])
        self._restarted({*_NAMES} - {*self._present}, begun_ns)
        self._overrides = {name for name in self._overrides if name.partition(".")[0] in names}
        self._present = names
        self._subject.statuses()

    def _change_cameras(self) -> None:
        others = [name for name in (*_COMING, _HOSTILE) if self._fuzz.random.random() < 0.6]
        names = [*STEADY, *others]
        self._fuzz.random.shuffle(names)
        self._set_cameras(names)

    def _set_bad_cameras(self) -> None:
        self._expect_refusal(cameras=self._choose(_BAD_CAMERAS))

    def _override(self) -> None:
        """Set one; contradictions and settings that do not exist are refused, all else is accepted."""
        name = self._choose([*self._present])
        table = _HARMLESS if name in STEADY else _HARMLESS | _DISTURBING
        setting = self._choose([*table])
        value = self._choose(table[setting])
        refusal = self._subject.node.set_parameters(**{f"{name}.{setting}": value})
        if not refusal:
            self._overrides.add(f"{name}.{setting}")
        elif setting not in ("track_high_threshold", "track_low_threshold", "no_such_setting", "max_rates"):
            self.problems.append(f"{name}.{setting} = {value} was refused: {refusal}")

    def _set_bad_override(self) -> None:
        name = self._choose([*self._present])
        self._expect_refusal(**{f"{name}.track_match_threshold": self._choose(_BAD_VALUES)})
        absent = [name for name in (*_COMING, _HOSTILE, "nobody") if name not in self._present]
        self._expect_refusal(**{f"{self._choose(absent)}.max_rate": 1.0})

    def _expect_refusal(self, **values: object) -> None:
        if not self._subject.node.set_parameters(**values):
            self.problems.append(f"{values} was accepted")

    def _inherit(self) -> None:
        if self._overrides:
            self._delete(self._choose(sorted(self._overrides)))

    def _delete(self, name: str) -> None:
        """As `ros2 param delete` does; one that would contradict what is inherited is refused."""
        message = Parameter(name, Parameter.Type.NOT_SET).to_parameter_msg()
        (result,) = self._subject.set_one_by_one([message])
        if result.successful:
            self._overrides.discard(name)
        elif "threshold" not in name:
            self.problems.append(f"{name} was not deleted: {result.reason}")

    def _overrides_of(self, camera_name: str) -> list[str]:
        return sorted(name for name in self._overrides if name.startswith(f"{camera_name}."))

    def _change_tracker(self) -> None:
        self._set(tracker=self._choose(["none", "bytetrack"]))

    def _reload(self) -> None:
        begun_ns = time.time_ns()
        before = self._subject.node.parameter("image_size")
        self._set(image_size=256 if before == 320 else 320)
        self._restarted(_NAMES, begun_ns)

    def _restarted(self, cameras: Collection[str], begun_ns: int) -> None:
        """Note that their trackers are new; the stamps of the hostile camera mean nothing."""
        self.track_ids.restart({*cameras} - {_HOSTILE}, begun_ns, time.time_ns())

    def _send_depth(self) -> None:
        for _ in range(5):
            for name in self._present:
                self.clients[name].send_depth()
            self._subject.observer.work_for(0.05)

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


def several_cameras(subject: Subject, seed: int, minutes: float, *, is_judged: bool = True) -> Finding:
    """Act at random on several cameras for `minutes`; rates and memory only decide if `is_judged`."""
    resident_mb: list[float] = []
    with CamerasLife(subject, seed) as life:
        begun_s = time.monotonic()
        heard = {name: life.clients[name].heard for name in STEADY}
        while not resident_mb or time.monotonic() < begun_s + 60 * minutes:
            for _ in range(_CHECK_EVERY):
                life.act()
            life.check()
            resident_mb.append(subject.resources().resident_mb)
        taken_s = time.monotonic() - begun_s
        rate = min(life.clients[name].heard - heard[name] for name in STEADY) / taken_s / _RATE_HZ
    subject.reset()
    problems = [*life.problems, *life.track_ids.problems, *subject.balance.problems]
    warm = len(resident_mb) // _WARM_UP
    growth_mb = max(resident_mb[-warm - 1 :]) - max(resident_mb[: warm + 1])
    return Finding(
        claim="cameras that come, go and misbehave disturb neither the others nor the process",
        done=f"{life.done.total()} actions of {len(life.done)} kinds on {len(_NAMES)} cameras in "
        f"{taken_s / 60:.0f} minutes, {len(life.track_ids)} tracks, seed {seed}",
        result=f"{number_of('wrong answers, counts or track ids', problems)}, "
        f"{number_of('exceptions', subject.escaped)}; the steady cameras at {rate:.0%} of their rate; "
        f"RSS {growth_mb:+.1f} MB",
        limit=f"0, 0; {f'{_MIN_RATE:.0%}; < {_MAX_GROWTH_MB:+g} MB' if is_judged else 'not judged'}",
        is_met=not problems
        and not subject.escaped
        and (not is_judged or (rate >= _MIN_RATE and growth_mb < _MAX_GROWTH_MB)),
    )
