"""What `detect_bag` reports about many recordings on the terminal."""

from __future__ import annotations

from collections import Counter
from typing import get_args

from yolov5_lifecycle.offline.many_recordings.recording_result import COUNTED, State
from yolov5_lifecycle.offline.many_recordings.supervisor import Tally
from yolov5_lifecycle.offline.terminal import ProgressLine, objects_line, order_line
from yolov5_lifecycle.process.standard_streams import complain


class RecordingsTerminal:
    """Reports what went wrong, and progress over all."""

    def __init__(self) -> None:
        self._line = ProgressLine()

    def remark(self, text: str) -> None:
        self.close()
        complain("detect_bag", text)

    def progress(self, tally: Tally) -> None:
        self._line.show(
            f"{len(tally.results)} of {tally.count} recordings, {tally.images} images, "
            f"{tally.rate_hz:.1f} per second"
        )

    def close(self) -> None:
        """End the progress line."""
        self._line.close()


def recordings_report(tally: Tally) -> str:
    """Summary of many recordings for the user, one fact per line."""
    results = tally.results.values()
    objects: Counter[str] = Counter()
    for result in results:
        objects.update(+Counter(result.detections))
    images = {name: sum(getattr(result, name) for result in results) for name in COUNTED}
    states = ", ".join(f"{tally.in_state(state)} {state}" for state in get_args(State))
    missing = f", {images['missing']} missing" if images["missing"] else ""
    return (
        f"recordings  {tally.count}: {states}\n"
        f"images      {images['images']}: {images['detected']} detected, {images['rejected']} rejected, "
        f"{images['failed']} failed{missing}\n"
        f"{objects_line(objects)}"
        f"{order_line(images['late'], images['jumps'])}"
        f"rate        {tally.rate_hz:.1f} images per second in this run\n"
    )
