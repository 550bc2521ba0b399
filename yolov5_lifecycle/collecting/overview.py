"""What a folder of collected images has, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from yolov5_lifecycle.collecting.record import CollectedFrame
from yolov5_lifecycle.printable import in_one_line

_NO_NAME = "(without a name)"


def overview(frames: Sequence[CollectedFrame]) -> str:
    """Images by drive, camera, model, reason and class, a line each, the most frequent first.

    An image with several reasons counts for each of them.
    """
    counts = {
        "drive": Counter(frame.drive for frame in frames),
        "camera": Counter(frame.camera or _NO_NAME for frame in frames),
        "model": Counter(frame.weights_sha256[:12] for frame in frames),
        "reason": Counter(reason for frame in frames for reason in frame.reasons),
        "class": Counter(_classes(frames)),
    }
    lines = [f"{'images':8}{len(frames):8}"]
    for kind, counter in counts.items():
        lines += [f"{kind:8}{count:8}  {in_one_line(name)}" for name, count in counter.most_common()]
    return "\n".join(lines) + "\n"


def _classes(frames: Iterable[CollectedFrame]) -> Iterable[str]:
    """Each class once for each image that has it."""
    return (name for frame in frames for name in {found.class_name for found in frame.objects})
