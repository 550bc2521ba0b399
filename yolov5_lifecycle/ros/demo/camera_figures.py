"""Quality of detection, tracking and placing for one camera of the demonstration, with the limits."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from yolov5_lifecycle.ros.demo.camera_record import JudgedFrame
from yolov5_lifecycle.ros.demo.ground_truth import matched

MIN_PRECISION = 0.9
MIN_RECALL = 0.9
MAX_SWITCHES = 0
MIN_PLACED = 0.8
"""Share of the tracked objects; a frame whose depth arrives too late has no places."""
MAX_MEDIAN_ERROR_PERCENT = 2.0


@dataclass(frozen=True)
class CameraFigures:
    """Figures of one camera. A box is right if its class and position are those of a true object."""

    frames: int
    rate_hz: float
    """Images in which objects were detected, per second of their stamps."""
    precision: float
    recall: float
    ids: tuple[str, ...]
    """Ids of the right boxes, in order of appearance."""
    switches: int
    """How often the id of a true object changed."""
    placed: float
    """Share of the right boxes with an id that have a place in space."""
    median_error_percent: float | None
    """Distance between true and found centre in space, in percent of the range; None without any."""
    p95_error_percent: float | None
    median_latency_ms: float

    def problems(self) -> list[str]:
        """Each figure that is worse than required, found and expected."""
        error = self.median_error_percent or 0.0  # without any, `placed` is too low
        checks = (
            (
                self.precision >= MIN_PRECISION,
                f"precision {self.precision:.1%}, expected at least {MIN_PRECISION:.0%}",
            ),
            (self.recall >= MIN_RECALL, f"recall {self.recall:.1%}, expected at least {MIN_RECALL:.0%}"),
            (self.switches <= MAX_SWITCHES, f"{self.switches} identity switches, expected {MAX_SWITCHES}"),
            (
                self.placed >= MIN_PLACED,
                f"{self.placed:.1%} of tracked objects placed in space, expected at least {MIN_PLACED:.0%}",
            ),
            (
                error <= MAX_MEDIAN_ERROR_PERCENT,
                f"error in space {error:.2f} %, expected at most {MAX_MEDIAN_ERROR_PERCENT:g} %",
            ),
        )
        return [problem for is_met, problem in checks if not is_met]

    def as_json(self) -> dict[str, object]:
        """All figures by name."""
        return asdict(self)


def figures(frames: Sequence[JudgedFrame]) -> CameraFigures:
    """The figures of at least two `frames` in the order of their stamps."""
    pairs = [matched(frame.truth, frame.found) for frame in frames]
    right = sum(map(len, pairs))
    tracks = _tracks(frames, pairs)
    errors = _errors_percent(frames, pairs)
    tracked = sum(map(len, tracks.values()))
    median, p95 = np.quantile(errors, (0.5, 0.95)).tolist() if errors else (None, None)
    return CameraFigures(
        frames=len(frames),
        rate_hz=_rate_hz([frame.found.stamp_ns for frame in frames]),
        precision=right / max(sum(len(frame.found.class_names) for frame in frames), 1),
        recall=right / max(sum(len(frame.truth.class_names) for frame in frames), 1),
        ids=tuple(dict.fromkeys(itertools.chain(*tracks.values()))),
        switches=sum(a != b for ids in tracks.values() for a, b in itertools.pairwise(ids)),
        placed=len(errors) / max(tracked, 1),
        median_error_percent=median,
        p95_error_percent=p95,
        median_latency_ms=statistics.median(frame.found.latency_ms for frame in frames),
    )


def _tracks(frames: Sequence[JudgedFrame], pairs: Sequence[list[tuple[int, int]]]) -> dict[str, list[str]]:
    """The ids that each true object has had, frame by frame."""
    tracks: dict[str, list[str]] = {}
    for frame, rows in zip(frames, pairs, strict=True):
        for true_row, row in rows:
            if name := frame.found.ids[row]:
                tracks.setdefault(frame.truth.ids[true_row], []).append(name)
    return tracks


def _errors_percent(frames: Sequence[JudgedFrame], pairs: Sequence[list[tuple[int, int]]]) -> list[float]:
    errors = []
    for frame, rows in zip(frames, pairs, strict=True):
        for true_row, row in rows:
            true, place = frame.true_places[frame.truth.ids[true_row]], frame.places.get(frame.found.ids[row])
            if place is not None:
                errors.append(100 * float(np.linalg.norm(place - true) / np.linalg.norm(true)))
    return errors


def _rate_hz(stamps_ns: Sequence[int]) -> float:
    return 1e9 * (len(stamps_ns) - 1) / (stamps_ns[-1] - stamps_ns[0])
