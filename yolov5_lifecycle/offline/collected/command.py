"""Command `collected ACTION FOLDER`: what a detector has collected."""

from __future__ import annotations

import argparse
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

from yolov5_lifecycle.atomic_file import OutputError, whole_output
from yolov5_lifecycle.collecting.collected_files import (
    DATA,
    FRAMES,
    IMAGES,
    MAX_LIST_BYTES,
    CollectingError,
    FrameLine,
    own_bytes,
    read_class_names,
    read_frame_list,
    with_names,
    write_description,
    write_frame_list,
)
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES, MAX_IMAGES, DataError, check_count
from yolov5_lifecycle.evaluation.yolo_labels import label_text, objects_in
from yolov5_lifecycle.offline.collected.arguments import command_parser
from yolov5_lifecycle.offline.collected.contact_sheet import contact_sheet
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import complain, write_output

_COMMAND = "collected"
_NO_LIMIT = Quota(max_bytes=1 << 62, max_frames=1 << 62, min_free_bytes=0)
SPLIT = "split.yaml"
_TOLERANCE = 1.25
"""Sessions for validation have at most so many times the share that was asked for."""


def main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)
    if arguments.action == "remove" and not (arguments.session or arguments.reason):
        parser.error("remove needs --session or --reason")
    try:
        return write_output(_COMMAND, _ACTIONS[arguments.action](arguments))
    except (CollectingError, DataError, OutputError, OSError) as error:
        complain(_COMMAND, in_one_line(str(error)))
        return 1


def _lines(folder: Path) -> tuple[FrameLine, ...]:
    """What is in `folder`; raises CollectingError if it is no folder of collected images."""
    _check(folder)
    return read_frame_list(folder).lines


def _check(folder: Path) -> None:
    if own_bytes(folder, FRAMES, MAX_LIST_BYTES) is None:
        raise CollectingError(f"{folder}: expected the collect_dir of a detector, found no {FRAMES} in it")


def _show(arguments: argparse.Namespace) -> str:
    """Images by session, camera, model, reason and class, the most frequent first, MAX_CLASSES lines each.

    An image with several reasons counts for each of them.
    """
    counts = {kind: Counter[str]() for kind in ("session", "camera", "model", "reason", "class")}
    for line in _lines(arguments.folder):
        frame = line.frame
        counts["session"][line.session] += 1
        counts["camera"][frame.camera or "(without a name)"] += 1
        counts["model"][frame.weights_sha256[:12]] += 1
        counts["reason"].update(frame.reasons.keys())
        counts["class"].update({found.class_name for found in frame.objects})
    shown = [f"{'images':8}{counts['session'].total():8}"]
    for kind, counter in counts.items():
        most = counter.most_common(MAX_CLASSES)
        shown += [f"{kind:8}{count:8}  {in_one_line(name)}" for name, count in most]
    return "\n".join(shown) + "\n"


def _sheet(arguments: argparse.Namespace) -> str:
    folder = arguments.folder
    lines = sorted(_lines(folder), key=lambda line: -line.value)[: arguments.most]
    class_names = read_class_names(folder, is_used=False)
    with whole_output(arguments.output) as unfinished, unfinished.open("w", encoding="utf-8") as file:
        title = f"{len(lines)} collected images: {folder.resolve().name}"
        file.writelines(contact_sheet(folder, lines, class_names, title=title))
    return f"{arguments.output}: {len(lines)} images\n"


def _split(arguments: argparse.Namespace) -> str:
    """Whole sessions for training or validation: neighbouring images show the same scene."""
    folder, counts = arguments.folder, Counter(line.session for line in _lines(arguments.folder))
    validation = validation_sessions(counts, arguments.share)
    paths = {session: f"{IMAGES}/{session}" for session in sorted(counts)}
    train = [path for session, path in paths.items() if session not in validation]
    class_names = read_class_names(folder, is_used=True)
    write_description(folder / SPLIT, class_names, train, [paths[session] for session in validation])
    count = sum(counts[session] for session in validation)
    return f"{folder / SPLIT}: {counts.total() - count} images for training, {count} for validation\n"


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
    smallest = min(counts, key=lambda session: (counts[session], session))
    return sorted(chosen or [smallest])


def _merge(arguments: argparse.Namespace) -> str:
    for folder in arguments.folders:
        _check(folder)
    with whole_output(arguments.output) as unfinished:
        count, repeated = merge(arguments.folders, unfinished)
    first = f"; {repeated} that a folder before had, too, are as in that one" if repeated else ""
    return f"{arguments.output}: {count} images{first}\n"


def merge(folders: Sequence[Path], output: Path) -> tuple[int, int]:
    """Copy the images of `folders` and their labels, as they are now, to the new folder `output`.

    Of an image that several folders have, the first folder's counts. Returns the number of images, and how
    many were left out for that. Classes are matched by name. Raises CollectingError if labels cannot be
    read, DataError beyond the limits of a data set or of the disk, and OSError.
    """
    sources: dict[str, tuple[Path, FrameLine, Sequence[int]]] = {}
    names: tuple[str, ...] = ()
    listed = 0
    for folder in folders:
        lines = read_frame_list(folder).lines
        own_names = read_class_names(folder, is_used=bool(lines))
        names = with_names(names, own_names)
        ids = {name: index for index, name in enumerate(names)}
        class_ids = [ids[name] for name in own_names]
        listed += len(lines)
        for line in lines:
            sources.setdefault(line.image, (folder, line, class_ids))
    merged = [line for _, line, _ in sources.values()]
    _check_limits(merged, len(names), shutil.disk_usage(output.parent).free)
    output.mkdir()
    for folder, line, ids_in_output in sources.values():
        _copy(folder, output, line, ids_in_output)
    write_description(output / DATA, names)
    write_frame_list(output, merged)
    return len(merged), listed - len(merged)


def _check_limits(lines: Sequence[FrameLine], class_count: int, free_bytes: int) -> None:
    limits = {
        "images": (len(lines), MAX_IMAGES),
        "classes": (class_count, MAX_CLASSES),
        f"bytes in {FRAMES}": (sum(len(line.text) for line in lines), MAX_LIST_BYTES),
        "bytes, which are free on the disk": (sum(line.size for line in lines), free_bytes),
    }
    for what, (count, limit) in limits.items():
        check_count("all folders", what, count, limit, remedy="merge fewer")


def _copy(folder: Path, output: Path, line: FrameLine, class_ids: Sequence[int]) -> None:
    for path in (output / line.image, output / line.labels):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        objects = objects_in(label_text(folder / line.labels) or "", len(class_ids))
    except DataError as error:
        raise CollectingError(f"{folder / line.labels}: {error}; correct it") from None
    rows = ((class_ids[class_id], *values) for class_id, values in objects)
    (output / line.labels).write_text("".join(f"{' '.join(map(str, row))}\n" for row in rows))
    shutil.copyfile(folder / line.image, output / line.image, follow_symlinks=False)


def _remove(arguments: argparse.Namespace) -> str:
    reasons, sessions = {*arguments.reason}, {*arguments.session}
    _check(arguments.folder)
    with closing(CollectedFolder(arguments.folder, _NO_LIMIT)) as folder:
        lines = folder.lines
        leaving = [
            line
            for line in lines
            if (not sessions or line.session in sessions)
            and (not reasons or reasons.issuperset(line.frame.reasons))
        ]
        for line in leaving:
            folder.remove(line)
    return f"{arguments.folder}: {len(leaving)} of {len(lines)} images removed\n"


_ACTIONS: Mapping[str, Callable[[argparse.Namespace], str]] = {
    "show": _show,
    "sheet": _sheet,
    "split": _split,
    "merge": _merge,
    "remove": _remove,
}
