"""Where a demonstration takes place: processes in a ROS domain of their own, one of them the detector."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from yolov5_lifecycle.input_file import resolve_package
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point, isolated, own_domain
from yolov5_lifecycle.ros.messages import image_of_message, stamp_ns
from yolov5_lifecycle.ros.observer import PATIENCE_S, Observer, RemoteLifecycleNode

OUTPUT = Path("build/demo")
DETECTOR = "/yolov5"
CONFIG = resolve_package("package://yolov5_lifecycle/config")

Commands = Mapping[str, str]
"""Command lines as in a shell, by the names of their processes; the last one is that of the detector."""
Received = dict[int, Any]
"""The messages on a topic by stamp in ns: none at first, more while the observer works."""
Report = Callable[[str], None]


class DemonstrationError(RuntimeError):
    """The detector misbehaved; the message describes the expected and the actual behaviour."""


class Stage:
    """Observes all nodes and drives the detector; calls `report` once per step.

    Its methods raise DemonstrationError for a refusal and TimeoutError on a timeout.
    """

    def __init__(self, observer: Observer, report: Report) -> None:
        self.observer = observer
        self.report = report
        self._subscriptions: dict[str, Any] = {}
        self.latencies_ms: dict[tuple[str, int], float] = {}  # by topic and stamp in ns
        self.node = RemoteLifecycleNode(observer, DETECTOR)
        report("waiting for the detector")
        self.node.wait_until_reachable()

    def transition(self, label: str) -> None:
        """Request the transition `label` and check that it succeeds."""
        self.report(label)
        if not self.node.change_state(label):
            raise DemonstrationError(f"the detector refused to {label}; its log says why")

    def set(self, **values: object) -> None:
        """Set parameters, all at once."""
        self.report("set " + ", ".join(f"{name}: {value}" for name, value in values.items()))
        if refusal := self.node.set_parameters(**values):
            raise DemonstrationError(f"setting {values} was refused: {refusal}")

    def collect(self, message_type: Any, topic: str) -> Received:
        """What comes on `topic` until it is released."""
        received: Received = {}

        def take(message: Any) -> None:
            stamp = stamp_ns(message.header)
            received[stamp] = message
            self.latencies_ms[topic, stamp] = (time.time_ns() - stamp) / 1e6

        self._subscriptions[topic] = self.observer.create_subscription(message_type, topic, take, 10)
        return received

    def release(self, *topics: str) -> None:
        """Collect no more messages on `topics`, which may cost the detector something."""
        for topic in topics:
            self.observer.destroy_subscription(self._subscriptions.pop(topic))

    def frames(
        self, count: int, *received: Received, since_ns: int | None = None
    ) -> dict[int, tuple[Any, ...]]:
        """What `received` have of the same images, by stamp, at least `count` of them.

        Only images that are stamped after `since_ns`, by default after this call.
        """
        begun_ns = time.time_ns() if since_ns is None else since_ns

        def frames() -> dict[int, tuple[Any, ...]]:
            stamps = sorted(stamp for stamp in set.intersection(*map(set, received)) if stamp > begun_ns)
            return {stamp: tuple(messages[stamp] for messages in received) for stamp in stamps}

        self.observer.wait_for(
            lambda: len(frames()) >= count,
            f"{count} images with messages on all of {', '.join(self._subscriptions)}",
            timeout_s=PATIENCE_S + count,
        )
        return frames()

    def annotated_image(self, topic: str, shown: Received) -> NDArray[np.uint8]:
        """Of five coming images (H, W, 3) in BGR on `topic` that with the most objects in `shown`.

        Not the first one, which may have been detected before it was known that masks would be drawn.
        """
        images = self.collect(Image, topic)
        _, *later = self.frames(6, images, shown).values()
        self.release(topic)
        best, _ = max(later, key=lambda messages: len(messages[1].detections))
        image = image_of_message(best)
        return image.pixels if image.channel_order == "bgr" else image.pixels[..., ::-1]

    def check(self, is_right: bool, found: str, expected: str) -> None:
        """Report what was found; raise DemonstrationError unless it is right."""
        self.report(found)
        if not is_right:
            raise DemonstrationError(f"{found}, expected {expected}")


@contextmanager
def stage(commands: Commands, report: Report) -> Iterator[Stage]:
    """Start `commands`; at the end of the block shut the detector down and end all of them.

    Raises DemonstrationError, TimeoutError and what `started` raises.
    """
    with started(commands) as processes:
        report("started " + ", ".join(f"{each.name} (process {each.process_id})" for each in processes))
        detector, watched = processes[-1], list(processes)

        def check() -> None:
            for process in watched:
                process.check_running()

        domain = int(os.environ["ROS_DOMAIN_ID"])
        try:
            with closing(Observer("demo", domain=domain, check=check)) as observer:
                yield (driven := Stage(observer, report))
                watched.remove(detector)  # it answers for a few more seconds, then ends
                driven.transition("shutdown")
        except (DemonstrationError, TimeoutError) as error:
            raise DemonstrationError(
                f"{error}. The detector's last output:\n{detector.last_words}"
            ) from error
    report(f"all {len(processes)} processes ended with exit code 0")


def show_live(commands: Commands, *, port: int, report: Report) -> None:
    """Run `commands` and the console until Ctrl-C.

    The detector may be shut down before that, as the page has a button for it. Raises RuntimeError if another
    process ends before that, and what `started` raises.
    """
    with started({"console": f"console --port {port}", **commands}) as processes:
        console, *_, detector = processes
        console.wait_for_output("console: http", 60.0)
        address = console.output.partition("console: http")[2].split()[0]
        domain = os.environ["ROS_DOMAIN_ID"]
        report(f"for ros2 commands in another terminal: export ROS_DOMAIN_ID={domain}")
        report(f"open http{address} in a browser; Ctrl-C stops everything")
        try:
            while True:
                for process in processes:
                    if process is not detector or process.exit_code != 0:
                        process.check_running()
                time.sleep(0.5)
        except KeyboardInterrupt:
            report("stopping all processes")


@contextmanager
def started(commands: Commands) -> Iterator[list[ChildProcess]]:
    """The processes of `commands` in a ROS domain of their own, which is this process's, too, from now on.

    After the block they are ended, the last one first; if it raises, they are terminated. Raises RuntimeError
    if one does not end with exit code 0 or if there is no free domain, and OSError.
    """
    OUTPUT.mkdir(parents=True, exist_ok=True)
    with own_domain() as domain, ExitStack() as stack:
        environment = {
            "AMENT_PREFIX_PATH": sys.prefix,
            **isolated(os.environ, domain),
            # Fast DDS needs shared memory that holds a whole image, here in all processes.
            "FASTRTPS_DEFAULT_PROFILES_FILE": f"{CONFIG}/shm.xml",
            "ROS_LOG_DIR": str(OUTPUT.absolute() / "log"),
        }
        os.environ.clear()
        os.environ.update(environment)
        processes = []
        for name, command in commands.items():
            executable, *words = shlex.split(command)
            process = ChildProcess(name, [entry_point(executable), *words], environment)
            processes.append(stack.enter_context(process))
        yield processes
        for process in reversed(processes):
            if code := process.stop():
                raise RuntimeError(f"the {process.name} ended with exit code {code} instead of 0")


def saved(pixels_bgr: NDArray[np.uint8], name: str) -> Path:
    """Write the pixels (H, W, 3) as PNG `name` in OUTPUT and return its path; raises OSError."""
    path = OUTPUT / name
    if not cv2.imwrite(str(path), pixels_bgr, [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise OSError(f"{path} cannot be written")
    return path
