"""Recordings of all scenes, and the ids that the tracker and the package `trackers` give in them."""

from __future__ import annotations

import itertools
import json
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark.tracking.figures import JudgedFrame, TrackCounts, track_counts
from benchmark.tracking.film import Film
from benchmark.tracking.recording import RecordedFrame, recorded
from benchmark.tracking.scenes import SCENES, TrackScene
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.sources.scene import CLASS_NAMES
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker

RATES_HZ = (5.0, 10.0, 30.0)
SETTINGS = Settings()
Scenes = Mapping[str, Callable[[np.random.Generator], TrackScene]]
Ids = list[tuple[str, ...]]
"""Of each detection of each frame."""


@dataclass(frozen=True, eq=False)
class Case:
    """A recording of the scene `name`."""

    name: str
    rate_hz: float
    frames: Sequence[RecordedFrame]


def simulated_cases(seeds: Iterable[int], scenes: Scenes = SCENES, *, with_film: bool = True) -> list[Case]:
    """Each of `scenes` at every rate, once for each of `seeds`, with simulated detections."""
    cases = []
    for seed, rate_hz, (name, scene) in itertools.product(seeds, RATES_HZ, scenes.items()):
        rng = np.random.default_rng(seed)
        film = Film(np.random.default_rng((seed, 1))) if with_film else None
        cases.append(Case(name, rate_hz, recorded(scene(rng), rate_hz, rng, film)))
    return cases


def own_ids(
    frames: Iterable[RecordedFrame], settings: Settings = SETTINGS, *, with_camera: bool = True
) -> Ids:
    """The ids that the tracker gives, with or without the motion of the camera."""
    tracker = ByteTracker(itertools.count(1))
    return [
        tracker.update(
            frame.detections,
            stamp_s=frame.stamp_s,
            settings=settings,
            camera=frame.camera if with_camera else None,
        )
        for frame in frames
    ]


def oracle_ids(python: Path, cases: Iterable[Case]) -> list[Ids]:
    """The ids that the package `trackers` in the environment of `python` gives, with the same thresholds."""
    requests = [_request(case) for case in cases]
    script = Path(__file__).with_name("oracle.py")
    run = subprocess.run(
        [python, script], input=json.dumps(requests), stdout=subprocess.PIPE, text=True, check=True
    )
    return [[tuple(names) for names in frames] for frames in json.loads(run.stdout)]


def _request(case: Case) -> dict[str, object]:
    return {
        "rate_hz": case.rate_hz,
        "class_ids": list(range(len(CLASS_NAMES))),
        "options": {
            "lost_track_buffer": round(30 * SETTINGS.track_timeout),  # in frames of 30 Hz, scaled to the rate
            "track_activation_threshold": SETTINGS.track_high_threshold,
            "high_conf_det_threshold": SETTINGS.track_high_threshold,
        },
        "frames": [
            {
                "stamp_s": frame.stamp_s,
                "boxes_xyxy": frame.detections.boxes_xyxy.tolist(),
                "scores": frame.detections.scores.tolist(),
                "class_ids": frame.detections.class_ids.tolist(),
            }
            for frame in case.frames
        ],
    }


def counts_of(frames: Iterable[RecordedFrame], ids: Ids) -> TrackCounts:
    """The counts of a recording whose detections were given `ids`."""
    return track_counts([_judged(frame, names) for frame, names in zip(frames, ids, strict=True)])


def _judged(frame: RecordedFrame, names: Sequence[str]) -> JudgedFrame:
    rows = [row for row, name in enumerate(names) if name]
    return JudgedFrame(
        frame.truth_ids,
        frame.truth_boxes_xyxy,
        [names[row] for row in rows],
        frame.detections.boxes_xyxy[rows],
    )
