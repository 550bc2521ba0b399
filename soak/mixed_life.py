"""Random mix of all actions, for any duration."""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from support.detector_process import NODE, scene_image

from soak.finding import Finding, number_of
from soak.hostile_messages import Fuzz, HostileClient, damaged_message, faulty_image, odd_image
from soak.subject import Resources, Sender, Subject, camera

_LABELS = ("configure", "activate", "activate", "deactivate", "cleanup", "nonsense")
_CAMERAS: dict[str, tuple[Any, ...]] = {
    "rate": (1.0, 10.0, 30.0, 100.0),
    "encoding": ("rgb8", "bgr8", "mono8", "rgba8", "bgra8"),
    "reliability": ("reliable", "best_effort"),
}
_SIZES_HW = ((64, 64), (240, 320), (480, 640), (720, 1280), (37, 501))
_SETTINGS: dict[str, tuple[Any, ...]] = {
    "image_size": (128, 320, 416, 417),
    "confidence_threshold": (0.0, 0.25, 0.9, 2.0),
    "max_detections": (1, 1000),
    "classes": (["circle"], ["cirlce"], ["0", "3"]),
    "class_thresholds": (["circle: 0.01", "1: 0.9"], [], ["cirlce: 0.5"], ["0: 0.5", "circle: 0.5"]),
    "regions": (["0,0 1,0 1,1 0,1"], [], ["0,0 1,1 1,0 0,1"]),
    "max_box_size": (0.0, 0.5, 200.0, -1.0),
    "max_rate": (0.0, 5.0),
    "lazy": (True, False),
    "image_transport": ("raw", "compressed"),
    "image_reliability": ("auto", "best_effort", "reliable"),
    "tracker": ("none", "bytetrack", "sort"),
    "track_low_threshold": (0.05, 0.1, 0.9),
    "track_timeout": (0.01, 1.5, 60.0, 0.0),
    "depth": (True, False),
    "cameras": ([], ["front", "rear"], ["rear", "left"], ["front", "front"]),
    "front.max_rate": (5.0, -1.0),
    "front.depth": (True, False),
    "front.track_match_threshold": (0.3, 2.5, "x"),
    "rear.tracker": ("bytetrack", "none"),
    "rear.image_transport": ("raw", "compressed"),
    "rear.regions": (["0,0 1,0 1,1 0,1"], []),
    "weights": ("/nowhere.pt",),
}
_FAULTS = ("raise", "out of memory", "NaN", "wrong shape", "slow")
_CHECK_EVERY = 50


class MixedLife:
    """One subject and all actions on it. A context manager that stops the camera on exit."""

    def __init__(self, subject: Subject, seed: int) -> None:
        self._subject = subject
        self._fuzz = Fuzz(seed)
        self._choose: Callable[[Any], Any] = self._fuzz.random.choice
        self._camera = ExitStack()
        self._viewer: Any = None
        self._client = HostileClient(subject)
        subject.bring_to("active")
        self._sender = Sender(subject)
        self._senders = [self._sender, *(Sender(subject, name=name) for name in ("front", "rear", "left"))]
        self.done: Counter[str] = Counter()
        self._actions: dict[str, tuple[int, Callable[[], object]]] = {
            "transitions": (10, lambda: subject.transition(self._choose(_LABELS))),
            "storms": (5, self._storm),
            "settings": (10, self._set),
            "hostile requests": (20, lambda: self._client.ask(self._fuzz)),
            "damaged messages": (20, lambda: self._send(damaged_message(self._fuzz))),
            "whole images": (10, lambda: self._send(scene_image())),
            "odd images": (5, lambda: self._send(odd_image(self._fuzz))),
            "depth images": (5, lambda: self._choose(self._senders).send_depth()),
            "deleted overrides": (2, self._inherit),
            "viewers": (2, self._change_viewer),
            "faults": (5, lambda: self._send(faulty_image(self._choose(_FAULTS)))),
            "hangs": (1, lambda: self._send(faulty_image("hang"))),
            "pauses": (3, lambda: subject.observer.work_for(self._fuzz.random.uniform(0, 0.5))),
            "cameras": (2, self._change_camera),
        }

    def __enter__(self) -> MixedLife:
        return self

    def __exit__(self, *_: object) -> None:
        self._camera.close()

    @property
    def unanswered(self) -> list[str]:
        return self._client.unanswered

    def act(self) -> None:
        """Perform one random action."""
        weights = [weight for weight, _ in self._actions.values()]
        (kind,) = self._fuzz.random.choices(list(self._actions), weights)
        self._actions[kind][1]()
        self.done[kind] += 1

    def check(self) -> None:
        """Restore the initial parameters; the node must detect, whatever has happened."""
        self._camera.close()
        self._subject.transition("deactivate")  # first, as the node may deactivate itself at any time
        self._subject.reset()
        self._subject.bring_to("active")
        self._sender.send_whole()

    def _send(self, image: Any) -> None:
        """From the only camera or a named one, which may not be there."""
        self._choose(self._senders).send(image)

    def _inherit(self) -> None:
        """Delete an override, as `ros2 param delete` does."""
        name = self._choose([name for name in _SETTINGS if "." in name])
        self._subject.set_one_by_one([Parameter(name, Parameter.Type.NOT_SET).to_parameter_msg()])

    def _storm(self) -> None:
        """Simultaneous transitions and reloads."""
        futures = [self._subject.begin_transition(self._choose(_LABELS)) for _ in range(3)]
        futures += [self._subject.begin_reload(self._choose(_SETTINGS["image_size"])) for _ in range(2)]
        self._subject.observer.wait_for(
            lambda: all(future.done() for future in futures), "answers in a storm"
        )

    def _change_viewer(self) -> None:
        """Subscribe to or unsubscribe from the annotated images."""
        observer = self._subject.observer
        if self._viewer is None:
            self._viewer = observer.create_subscription(Image, f"{NODE}/image", lambda _: None, 1)
        else:
            observer.destroy_subscription(self._viewer)
            self._viewer = None

    def _set(self) -> None:
        name = self._choose(list(_SETTINGS))
        if name == "cameras":
            self._subject.hear_cameras()
        self._subject.node.set_parameters(**{name: self._choose(_SETTINGS[name])})

    def _change_camera(self) -> None:
        """Start another camera, or none."""
        self._camera.close()
        if self._fuzz.random.random() < 0.8:
            height, width = self._choose(_SIZES_HW)
            chosen = {name: self._choose(values) for name, values in _CAMERAS.items()}
            process = camera(self._subject.domain, height=height, width=width, **chosen)
            self._camera.enter_context(process)


def mixed_life(subject: Subject, seed: int, minutes: float) -> Finding:
    """Perform random actions for `minutes`, then terminate the process with SIGTERM."""
    end_s = time.monotonic() + 60 * minutes
    held: list[Resources] = []
    with MixedLife(subject, seed) as life:
        while not held or time.monotonic() < end_s:
            for _ in range(_CHECK_EVERY):
                life.act()
            life.check()
            held.append(subject.resources())
    code = subject.process.stop(signal.SIGTERM)
    return Finding(
        claim="everything at random leaves a node that detects",
        done=f"{life.done.total()} actions of {len(life.done)} kinds in {minutes:g} minutes, "
        f"{len(held)} checks, seed {seed}",
        result=f"{number_of('unanswered', life.unanswered)}, {number_of('exceptions', subject.escaped)}, "
        f"exit code {code}; RSS {held[0].resident_mb:.0f} -> {held[-1].resident_mb:.0f} MB",
        limit="0, 0; detects at every check; 0",
        is_met=not life.unanswered and not subject.escaped and code == 0,
    )
