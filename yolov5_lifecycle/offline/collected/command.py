"""Command `collected ACTION FOLDER`: what a detector has collected."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.collecting.collected_files import (
    FRAMES,
    IMAGES,
    CollectingError,
    kept_images,
    read_class_names,
    write_description,
)
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES
from yolov5_lifecycle.folder_listing import FolderTree
from yolov5_lifecycle.offline.collected.arguments import command_parser
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import complain, write_output
from yolov5_lifecycle.sources.source import IMAGE_SUFFIXES

_COMMAND = "collected"
SPLIT = "split.yaml"
_TOLERANCE = 1.25
"""Sessions for validation have at most so many times the share that was asked for."""


def main(argv: Sequence[str] | None = None) -> int:
    arguments = command_parser().parse_args(argv)
    try:
        folder = arguments.folder
        if not (folder / FRAMES).is_dir():
            raise CollectingError(
                f"{folder}: expected the collect_dir of a detector, found no {FRAMES} in it"
            )
        action = _show if arguments.action == "show" else _split
        return write_output(_COMMAND, action(arguments))
    except (CollectingError, OSError) as error:
        complain(_COMMAND, in_one_line(str(error)))
        return 1


def _show(arguments: argparse.Namespace) -> str:
    """Images by session, camera, model, reason and class, the most frequent first, MAX_CLASSES lines each.

    An image with several reasons counts for each of them.
    """
    counts = {kind: Counter[str]() for kind in ("session", "camera", "model", "reason", "class")}
    for kept, frame in kept_images(arguments.folder):
        counts["session"][kept.session] += 1
        counts["camera"][frame.camera or "(without a name)"] += 1
        counts["model"][frame.weights_sha256[:12]] += 1
        counts["reason"].update(frame.reasons.keys())
        counts["class"].update({found.class_name for found in frame.objects})
    _tell_others(arguments.folder, counts["session"].total())
    shown = [f"{'images':8}{counts['session'].total():8}"]
    for kind, counter in counts.items():
        most = counter.most_common(MAX_CLASSES)
        shown += [f"{kind:8}{count:8}  {in_one_line(name)}" for name, count in most]
    return "\n".join(shown) + "\n"


def _split(arguments: argparse.Namespace) -> str:
    """Whole sessions for training or validation: neighbouring images show the same scene."""
    folder = arguments.folder
    counts = Counter(kept.session for kept, _ in kept_images(folder))
    _tell_others(folder, counts.total())
    validation = validation_sessions(counts, arguments.share)
    paths = {session: f"{IMAGES}/{session}" for session in sorted(counts)}
    train = [path for session, path in paths.items() if session not in validation]
    class_names = read_class_names(folder, is_used=True)
    write_description(folder / SPLIT, class_names, train, [paths[session] for session in validation])
    count = sum(counts[session] for session in validation)
    return f"{folder / SPLIT}: {counts.total() - count} images for training, {count} for validation\n"


def _tell_others(folder: Path, count: int) -> None:
    """Tell of images besides the `count` with a record, which `evaluate` and a trainer would read, too."""
    images = (path for path in FolderTree().files(folder / IMAGES) if path.suffix.lower() in IMAGE_SUFFIXES)
    if (others := sum(1 for _ in images) - count) > 0:
        complain(
            _COMMAND,
            f"{others} images in {folder / IMAGES} have no record in {FRAMES}, as after they were renamed: "
            "they are not counted, and in no part of a split",
        )


def validation_sessions(counts: Counter[str], share: float) -> list[str]:
    """Sessions with about `share` of the images, of which each has some; at least one session, and not all.

    Raises CollectingError if there are fewer than two.
    """
    if len(counts) < 2:
        raise CollectingError(
            f"expected images of at least two sessions, found {len(counts)}: a part of a session is no test "
            "of what was learnt from the rest"
        )
    left, chosen = _TOLERANCE * share * counts.total(), list[str]()
    by_size = sorted(counts, key=lambda session: (-counts[session], session))
    for session in by_size:
        if len(chosen) < len(counts) - 1 and counts[session] <= left:
            chosen.append(session)
            left -= counts[session]
    return sorted(chosen or by_size[-1:])
