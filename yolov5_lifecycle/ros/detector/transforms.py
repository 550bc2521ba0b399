"""Results in another frame than the camera's: each waits for its transform, and is sent or dropped.

tf2 keeps the transforms; it is needed only with `target_frame`.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from enum import Enum
from typing import Any, Protocol

from geometry_msgs.msg import Transform
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.time import Time
from rclpy.timer import Timer
from std_msgs.msg import Header

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.ros.detector.depth import RECENT_S
from yolov5_lifecycle.ros.messages import stamp_ns
from yolov5_lifecycle.settings.schema import SEPARATOR, Problem
from yolov5_lifecycle.settings.settings import Settings


class Untransformed(Enum):
    """Why a result has no transform at its stamp."""

    NO_TRANSFORM = "no transform"
    TOO_OLD = "too old"
    EXTRAPOLATION = "extrapolation"
    TOO_MANY = "too many wait"


class Transforms(Protocol):
    """The transforms between frames over the last seconds; called in any thread, but `close`."""

    def look_up(self, target: str, source: str, stamp_ns: int) -> Transform | Untransformed:
        """From `source` to `target` at that time."""

    def forget(self) -> None:
        """Forget transforms that change: time begins again."""

    def close(self) -> None:
        """Receive no more."""


class Tf2(Transforms):
    """What tf2 receives on /tf and /tf_static with subscriptions of `node`; ImportError without tf2."""

    def __init__(self, node: Node) -> None:
        import tf2_ros

        self._tf2: Any = tf2_ros
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def look_up(self, target: str, source: str, stamp_ns: int) -> Transform | Untransformed:
        if stamp_ns <= 0:  # which is the latest time for tf2
            return Untransformed.TOO_OLD
        try:
            try:
                stamp = Time(nanoseconds=stamp_ns)
                return self._buffer.lookup_transform_core(target, source, stamp).transform
            except self._tf2.ExtrapolationException:
                latest_ns = self._buffer.get_latest_common_time(target, source).nanoseconds
                return Untransformed.TOO_OLD if latest_ns > stamp_ns else Untransformed.EXTRAPOLATION
        except self._tf2.TransformException:
            return Untransformed.NO_TRANSFORM

    def forget(self) -> None:
        self._buffer.clear()

    def close(self) -> None:
        self._listener.unregister()


def frame_problems(settings: Settings, listen: Callable[[Node], Transforms]) -> Iterator[Problem]:
    """Settings and overrides that name a frame although tf2, which `listen` may need, is missing."""
    absence = absence_of("tf2_ros") if listen is Tf2 else ""
    of_cameras = {f"{name}{SEPARATOR}": settings.for_camera(name) for name in settings.cameras}
    for prefix, own in {"": settings, **of_cameras}.items():
        frame = own.target_frame
        if absence and frame and not (prefix and frame == settings.target_frame):
            yield Problem(f"{prefix}target_frame", f"'{in_one_line(frame)}' needs tf2. {absence}")


_JUMP_NS = 1_000_000_000
"""Stamps that go back further mean that time begins again, as when a recording is played again."""


@dataclass(eq=False)
class TransformInput:
    """Owns what `listen` makes while a camera needs transforms."""

    node: Node
    listen: Callable[[Node], Transforms] = Tf2

    def __post_init__(self) -> None:
        self._users = set[object]()
        self._transforms: Transforms | None = None
        self._newest_ns = 0

    def follow(self, user: object, *, is_needed: bool) -> None:
        """In the executor: listen if this or another user needs transforms, else forget what was received."""
        (self._users.add if is_needed else self._users.discard)(user)
        if self._users and self._transforms is None:
            self._transforms = self.listen(self.node)
        elif not self._users and self._transforms is not None:
            self._transforms.close()
            self._transforms = None

    def look_up(self, target: str, source: str, stamp_ns: int) -> Transform | Untransformed:
        """See `Transforms`; a frame is always where it is itself."""
        if target == source:
            return Transform()
        if (transforms := self._transforms) is None:
            return Untransformed.NO_TRANSFORM
        return transforms.look_up(target, source, stamp_ns)

    def notice_jump(self, stamp_ns: int, before_ns: int) -> None:
        """Forget transforms if the stamps of a camera jumped back, and no other camera's have before."""
        has_jumped = stamp_ns < min(before_ns, self._newest_ns) - _JUMP_NS
        if has_jumped and (transforms := self._transforms) is not None:
            transforms.forget()
        self._newest_ns = stamp_ns if has_jumped else max(stamp_ns, self._newest_ns)


MAX_WAITING = 64
"""Results of a camera, up to two of each image; more are dropped."""
_RETRY_S = 0.01
_REMEDIES = {
    Untransformed.NO_TRANSFORM: "start what publishes it, such as robot_state_publisher, or correct "
    "target_frame; `ros2 run tf2_tools view_frames` draws the tree",
    Untransformed.TOO_OLD: "tf knows only later ones: it is a first image, it came more than 10 s late, or "
    "its stamp is of another clock",
    Untransformed.EXTRAPOLATION: "tf came later than transform_timeout_s: raise it, or set the clocks",
    Untransformed.TOO_MANY: f"tf comes later than {MAX_WAITING} results of the camera: make tf faster, or "
    "lower max_rate",
}

_NAMELESS = "the images and depth images have no frame_id; set it in the driver of the camera"


@dataclass(frozen=True)
class _Result:
    source: str
    stamp_ns: int
    deadline_s: float
    send: Callable[[Transform], None]


@dataclass(eq=False)
class FrameOutput:
    """Sends a camera's results in space in `target_frame`, in their order, as soon as tf has the transform.

    What has none `timeout_s` after it was offered is dropped, and counted with the reason. `offer` is called
    in an inference thread and waits for nothing; the rest in the executor. `clock` returns monotonic seconds.
    """

    node: Node
    transforms: TransformInput
    _: KW_ONLY
    target_frame: str
    timeout_s: float
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._waiting: deque[_Result] = deque()
        self._last_ns = 0
        self._is_closed = False
        self.counts = dict.fromkeys(Untransformed, 0)
        self._problem, self._happened_s = "", float("-inf")
        self._timer: Timer | None = None

    def close(self) -> None:
        """Drop what waits; nothing is sent any more."""
        self._is_closed = True
        self._waiting.clear()
        self._retry(is_needed=False)

    def offer(self, header: Header, frame_id: str, send: Callable[[Transform], None]) -> None:
        """Have `send` called with the transform from `frame_id` at that stamp, now if it is known."""
        if self._is_closed or (executor := self.node.executor) is None:
            return
        before_ns, self._last_ns = self._last_ns, stamp_ns(header)
        self.transforms.notice_jump(self._last_ns, before_ns)
        deadline_s = self.clock() + self.timeout_s
        result = _Result(frame_id.lstrip("/"), self._last_ns, deadline_s, send)
        if not self._waiting and isinstance(found := self._look_up(result), Transform):
            send(found)
        elif len(self._waiting) < MAX_WAITING:
            self._waiting.append(result)
            executor.create_task(self._send_first)
        else:
            executor.create_task(self._drop, result, Untransformed.TOO_MANY)

    def values(self) -> dict[str, str]:
        """For diagnostics: how many results were dropped for each reason."""
        return {f"not transformed: {reason.value}": str(count) for reason, count in self.counts.items()}

    @property
    def hint(self) -> str:
        """Why results are dropped; "" if none was lately."""
        return self._problem if self.clock() - self._happened_s < RECENT_S else ""

    def _look_up(self, result: _Result) -> Transform | Untransformed:
        return self.transforms.look_up(self.target_frame, result.source, result.stamp_ns)

    def _send_first(self) -> None:
        """Send the first that waits if it has its transform now, or drop it if it has waited too long.

        One at a time, so that other callbacks are served.
        """
        if self._is_closed:
            self._waiting.clear()  # of what was offered at the same time
        if self._waiting:
            result = self._waiting[0]  # it stays in the queue, so that newer ones are not sent before it
            found = self._look_up(result)
            is_late = found is Untransformed.TOO_OLD or self.clock() >= result.deadline_s
            try:
                if isinstance(found, Transform):
                    result.send(found)
                elif is_late:
                    self._drop(result, found)
            finally:
                if is_late or isinstance(found, Transform):
                    self._waiting.popleft()
        self._retry(is_needed=bool(self._waiting))

    def _retry(self, *, is_needed: bool) -> None:
        if is_needed and self._timer is None:
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            self._timer = self.node.create_timer(_RETRY_S, self._send_first, clock=steady)
        elif not is_needed and self._timer is not None:
            self.node.destroy_timer(self._timer)
            self._timer = None

    def _drop(self, result: _Result, reason: Untransformed) -> None:
        self.counts[reason] += 1
        self._happened_s = self.clock()
        if not result.source.strip():
            self._problem = f"{reason.value}: {_NAMELESS}"
            return
        frames = f"from {in_one_line(result.source)} to {in_one_line(self.target_frame)}"
        self._problem = f"{reason.value} {frames} at the stamp of the image: {_REMEDIES[reason]}"
