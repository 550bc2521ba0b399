"""Measure how well and how fast objects are tracked."""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmark.report import Goal, Row, goal_table, row, table
from benchmark.track_figures import JudgedFrame, TrackCounts, track_counts
from benchmark.track_recording import Detect, RecordedFrame, recorded, simulated
from benchmark.track_scenes import SCENES, SIZE_HW
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.sources.scene import CLASS_NAMES
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker, TrackerSettings

RATES_HZ = (5.0, 10.0, 30.0)
SETTINGS = TrackerSettings()
ORACLE_MARGIN = 0.01
"""Max difference of IDF1 below that of the oracle."""
Ids = list[tuple[str, ...]]
"""Of each detection of each frame."""


@dataclass(frozen=True, eq=False)
class Case:
    """A recording of the scene `name`."""

    name: str
    rate_hz: float
    frames: Sequence[RecordedFrame]


def simulated_cases(seeds: Iterable[int]) -> list[Case]:
    """Every scene at every rate, once for each of `seeds`, with simulated detections."""
    return _cases(seeds, simulated)


def rendered_cases(seeds: Iterable[int]) -> list[Case]:
    """Every scene at every rate, once for each of `seeds`, drawn, with detections of the embedded model."""
    from benchmark.track_rendering import rendered, shapes_detector

    with closing(shapes_detector()) as detector:
        return _cases(seeds, partial(rendered, detector))


def _cases(seeds: Iterable[int], detect: Callable[[np.random.Generator], Detect]) -> list[Case]:
    cases = []
    for seed, rate_hz, (name, scene) in itertools.product(seeds, RATES_HZ, SCENES.items()):
        rng = np.random.default_rng(seed)
        cases.append(Case(name, rate_hz, recorded(scene(rng), rate_hz, rng, detect(rng))))
    return cases


def own_ids(frames: Iterable[RecordedFrame], settings: TrackerSettings = SETTINGS) -> Ids:
    """The ids that the tracker gives."""
    tracker = ByteTracker(itertools.count(1))
    return [tracker.update(frame.detections, stamp_s=frame.stamp_s, settings=settings) for frame in frames]


def oracle_ids(python: Path, cases: Iterable[Case]) -> list[Ids]:
    """The ids that the package `trackers` in the environment of `python` gives, with the same thresholds."""
    requests = [_request(case) for case in cases]
    script = Path(__file__).with_name("track_oracle.py")
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


def identity_table(
    cases: Sequence[Case], counts: Sequence[Sequence[TrackCounts]], names: Sequence[str]
) -> str:
    """A line for each scene and rate: IDF1, HOTA and switches of each of `names`.

    `counts` has those of every case for each name.
    """
    heads = f"{'scene':12}{'Hz':>4}{'objects':>9}" + "".join(
        f"  {name:>8}: IDF1   HOTA switches" for name in names
    )
    lines = [heads, "-" * len(heads)]
    for key in [*sorted({(case.name, case.rate_hz) for case in cases}), ("all", 0.0)]:
        chosen = [key in ((case.name, case.rate_hz), ("all", 0.0)) for case in cases]
        sums = [sum(itertools.compress(each, chosen), TrackCounts()) for each in counts]
        figures = "".join(f"{s.idf1:16.3f}{s.hota:7.3f}{s.switches:9}" for s in sums)
        lines.append(f"{key[0]:12}{key[1] or '':>4}{sums[0].truths:9}{figures}")
    return "\n".join(lines)


def _oracle_goals(
    what: str, cases: Sequence[Case], counts: Sequence[Sequence[TrackCounts]]
) -> Iterator[Goal]:
    for rate_hz in RATES_HZ:
        chosen = [case.rate_hz == rate_hz for case in cases]
        own, oracle = (sum(itertools.compress(each, chosen), TrackCounts()).idf1 for each in counts)
        goal = f"IDF1 less the oracle's, {what}, {rate_hz:g} Hz"
        yield Goal(goal, 0, own - oracle, False, -ORACLE_MARGIN)


def update_times_ms(count: int, frames: int, rng: np.random.Generator) -> list[float]:
    """Milliseconds of each update with `count` moving objects, a tenth of them with a low score."""
    height, width = SIZE_HW
    centres = rng.uniform((0, 0), (width * 3, height * 3), (count, 2))
    half_sides = rng.uniform(15, 50, (count, 2))
    speeds = rng.uniform(-60, 60, (count, 2))
    scores = np.sort(rng.uniform(0.2, 0.9, count))[::-1].astype(np.float32)
    tracker = ByteTracker(itertools.count(1))
    times_ms = []
    for number in range(frames):
        places = centres + speeds * number / 30 + rng.normal(0, 1, (count, 2))
        boxes = np.concatenate((places - half_sides, places + half_sides), axis=1).astype(np.float32)
        found = Detections(boxes, scores, np.zeros(count, np.int64))
        begun_s = time.perf_counter()
        tracker.update(found, stamp_s=number / 30, settings=SETTINGS)
        times_ms.append(1000 * (time.perf_counter() - begun_s))
    return times_ms


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; returns 1 if a goal is missed."""
    options = parser().parse_args(arguments)
    goals: list[Goal] = []
    makers = [("simulated", simulated_cases, options.seeds), ("rendered", rendered_cases, options.rendered)]
    for what, make_cases, seeds in makers:
        if not seeds:
            continue
        cases = make_cases(range(seeds))
        counts = [[counts_of(case.frames, own_ids(case.frames)) for case in cases]]
        if options.oracle:
            answers = oracle_ids(options.oracle, cases)
            counts.append([counts_of(case.frames, ids) for case, ids in zip(cases, answers, strict=True)])
            goals += _oracle_goals(what, cases, counts)
        print(f"{what}\n{identity_table(cases, counts, ('own', 'oracle')[: len(counts)])}\n")
    rows = _times()
    goals.append(Goal("50 objects [ms]", 0, rows[0].median, True, 1.0))
    print(f"{table(rows)}\n\n{goal_table(goals)}")
    return int(not all(goal.is_reached for goal in goals))


def _times() -> list[Row]:
    rng = np.random.default_rng(0)
    return [
        row("update", f"{count} objects", 0, update_times_ms(count, frames, rng)[5:])
        for count, frames in ((50, 300), (10, 300), (1000, 30))
    ]


def parser() -> argparse.ArgumentParser:
    """The argument parser."""
    parser = argparse.ArgumentParser(prog="benchmark.tracking", description=__doc__)
    parser.add_argument(
        "--seeds", type=int, default=5, metavar="N", help="scenes of each kind; default: %(default)s"
    )
    parser.add_argument("--rendered", type=int, default=0, metavar="N", help="the same, in drawn images")
    parser.add_argument("--oracle", type=Path, metavar="PYTHON", help="interpreter that has `trackers`")
    return parser


if __name__ == "__main__":
    sys.exit(main())
