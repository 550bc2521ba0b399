"""Tracks with the package `trackers` (Apache-2.0), for comparison: JSON from stdin, ids to stdout.

A script of its own, for an environment that has `trackers` and nothing of this project. It associates across
classes; with one tracker for each class, as here, it is better in scenes of several.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from functools import partial
from typing import Any

import numpy as np
import supervision
from trackers import ByteTrackTracker


def tracked(request: dict[str, Any]) -> list[list[str]]:
    """The id of each detection of each frame of one recording, "" for none."""
    trackers: defaultdict[int, Any] = defaultdict(
        partial(ByteTrackTracker, frame_rate=request["rate_hz"], **request["options"])
    )
    ids = []
    for frame in request["frames"]:
        columns = (np.array(frame[name]) for name in ("boxes_xyxy", "scores", "class_ids"))
        boxes_xyxy, scores, class_ids = columns
        ids.append([""] * len(scores))
        for class_id in request["class_ids"]:
            rows = np.flatnonzero(class_ids == class_id)
            found = supervision.Detections(
                xyxy=boxes_xyxy.reshape(-1, 4)[rows],
                confidence=scores[rows],
                class_id=np.full(len(rows), class_id),
                data={"row": rows},
            )
            answer = trackers[class_id].update(found, timestamp=frame["stamp_s"])
            for row, number in zip(answer.data.get("row", ()), answer.tracker_id, strict=True):
                if number >= 0:
                    ids[-1][row] = f"{class_id}-{number}"
    return ids


if __name__ == "__main__":
    json.dump([tracked(request) for request in json.load(sys.stdin)], sys.stdout)
