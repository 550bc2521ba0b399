"""What a folder of collected images has, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from yolov5_lifecycle.collecting.record import CollectedFrame
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES
from yolov5_lifecycle.printable import in_one_line

_NO_NAME = "(without a name)"


def overview(frames: Iterable[CollectedFrame]) -> str:
    """Images by drive, camera, model, reason and class, a line each, the most frequent first.

    An image with several reasons counts for each of them. Of each kind there are MAX_CLASSES lines at most.
    """
    counts = {kind: Counter[str]() for kind in ("drive", "camera", "model", "reason", "class")}
    for frame in frames:
        counts["drive"][frame.drive] += 1
        counts["camera"][frame.camera or _NO_NAME] += 1
        counts["model"][frame.weights_sha256[:12]] += 1
        counts["reason"].update(frame.reasons.keys())
        counts["class"].update({found.class_name for found in frame.objects})
    lines = [f"{'images':8}{counts['drive'].total():8}"]
    for kind, counter in counts.items():
        most = counter.most_common(MAX_CLASSES)
        lines += [f"{kind:8}{count:8}  {in_one_line(name)}" for name, count in most]
    return "\n".join(lines) + "\n"
