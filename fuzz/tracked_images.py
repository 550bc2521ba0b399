"""Fuzz target: any detections of two cameras, with any stamps and changing settings, given to trackers."""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fuzz.inputs import Fields
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.tracking.byte_tracker import (
    MAX_LATE_S,
    MAX_TRACKS,
    STEP_WITHOUT_TIME_S,
    ByteTracker,
)
from yolov5_lifecycle.tracking.motion import Similarity

_SETTINGS = struct.Struct("<5B")
_IMAGE = struct.Struct("<BiIB")
"""Flags, seconds and nanoseconds of the stamp, number of detections; then as many as the data has."""
_SMALL = struct.Struct("<6B")
_LARGE = struct.Struct("<4f2B")
"""Two corners, score and class."""
_OTHER_CAMERA, _ABSOLUTE, _LARGE_BOXES, _NEW_SETTINGS = 1, 2, 4, 8
"""Flags of an image; a stamp that is not absolute is less than 2 s after that of the image before."""


def check_tracked_images(data: bytes) -> None:
    """Expect that an id belongs to one object of one camera, and is never used again."""
    fields = Fields(data)
    settings = _settings(fields)
    ids = itertools.count(1)
    used: set[int] = set()
    cameras = [_Camera(ByteTracker(ids), used) for _ in range(2)]
    while fields.left:
        flags, seconds, nanoseconds, count = fields.unpack(_IMAGE)
        if flags & _NEW_SETTINGS:
            settings = _settings(fields)
        camera = cameras[bool(flags & _OTHER_CAMERA)]
        stamp_s = seconds + nanoseconds * 1e-9
        if not flags & _ABSOLUTE and math.isfinite(camera.stamp_s):
            stamp_s = camera.stamp_s + nanoseconds % 2_000_000_000 * 1e-9
        found = _detections(fields, count, _LARGE if flags & _LARGE_BOXES else _SMALL)
        camera.see(found, stamp_s, settings)


@dataclass
class _Seen:
    """The class of an object, and the time since it was last seen."""

    class_id: int
    unseen_s: float = 0.0


class _Camera:
    """A tracker, and the objects of its ids; `used` are the ids of all cameras."""

    def __init__(self, tracker: ByteTracker, used: set[int]) -> None:
        self._tracker = tracker
        self._used = used
        self._known: dict[int, _Seen] = {}
        self.stamp_s = -math.inf

    def see(self, found: Detections, stamp_s: float, settings: Settings) -> None:
        """Give `found` to the tracker and judge the ids that it returns."""
        is_late = 0 < self.stamp_s - stamp_s <= MAX_LATE_S
        camera = _camera(len(found)) if settings.track_camera_motion == "auto" else None
        ids = self._tracker.update(found, stamp_s=stamp_s, settings=settings, camera=camera)
        if is_late:
            assert ids == ("",) * len(found)
            return
        self._forget(stamp_s, settings.track_timeout)
        assert self._tracker.confirmed <= len(self._tracker) <= MAX_TRACKS
        assert len(ids) == len(found)
        self._judge(ids, found, settings)

    def _forget(self, stamp_s: float, timeout_s: float) -> None:
        """Advance to `stamp_s`: objects not seen for the timeout, or last seen before a jump, are gone."""
        step_s = stamp_s - self.stamp_s or STEP_WITHOUT_TIME_S
        self.stamp_s = stamp_s
        if not 0 < step_s <= timeout_s:
            self._known.clear()
        for seen in self._known.values():
            seen.unseen_s += step_s
        self._known = {name: seen for name, seen in self._known.items() if seen.unseen_s <= timeout_s}

    def _judge(self, ids: Sequence[str], found: Detections, settings: Settings) -> None:
        given = [int(name) for name in ids if name]
        assert len(set(given)) == len(given), "two objects of one image have the same id"
        rows = zip(ids, found.class_ids.tolist(), found.scores, strict=True)
        for name, class_id, score in rows:
            if not name:
                continue
            assert score >= np.float32(settings.track_low_threshold)
            seen = self._known.get(int(name))
            assert seen is not None or int(name) not in self._used, "an id is used again"
            if seen is not None and not settings.track_across_classes:
                assert seen.class_id == class_id
            self._known[int(name)] = _Seen(class_id)
        self._used.update(given)


def _settings(fields: Fields) -> Settings:
    high, low, match, timeout, across = fields.unpack(_SETTINGS)
    return Settings(
        track_high_threshold=high / 255,
        track_low_threshold=high / 255 * (low / 255),
        track_match_threshold=max(match / 255, 0.01),
        track_timeout=60.0 * (timeout + 1) / 256,
        track_across_classes=bool(across & 1),
        track_camera_motion="auto" if across & 2 else "off",
    )


def _camera(number: int) -> Similarity:
    """A motion that is possible, another one for each `number`."""
    angle, zoom = 0.1 * math.sin(number), 1 + 0.1 * math.cos(number)
    cos, sin = zoom * math.cos(angle), zoom * math.sin(angle)
    return np.array(((cos, -sin, 7.0 * number), (sin, cos, -3.0 * number)))


def _detections(fields: Fields, count: int, layout: struct.Struct) -> Detections:
    """`count` detections, or as many as are left, best first."""
    count = min(count, fields.left // layout.size)
    rows = np.array([fields.unpack(layout) for _ in range(count)], np.float32).reshape(-1, 6)
    rows = np.nan_to_num(rows[np.argsort(-rows[:, 4], kind="stable")])
    boxes = np.sort(rows[:, :4].reshape(-1, 2, 2), axis=1).reshape(-1, 4)
    return Detections(boxes, rows[:, 4] / np.float32(255), rows[:, 5].astype(np.int64))


def seeds() -> Iterator[bytes]:
    """Two objects in ten images of one camera and of two; then time that jumps."""
    settings = _SETTINGS.pack(64, 100, 51, 5, 0)
    box = _SMALL.pack(20, 20, 60, 80, 230, 1), _LARGE.pack(120.0, 30.0, 150.0, 60.0, 90, 2)
    for flags in (0, _LARGE_BOXES):
        objects = box[bool(flags)] * 2
        images = [_IMAGE.pack(flags | number % 2, 0, 100_000_000, 2) + objects for number in range(10)]
        yield settings + b"".join(images)
        jumps = [_IMAGE.pack(flags | _ABSOLUTE, sec, 0, 2) + objects for sec in (5, 6, 2, 2, -1, 2**31 - 1)]
        yield settings + b"".join(jumps)
