"""Command `collected ACTION FOLDER`: what a detector has collected."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

from yolov5_lifecycle.atomic_file import OutputError, whole_output
from yolov5_lifecycle.collecting.class_list import read_class_names
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota
from yolov5_lifecycle.collecting.contact_sheet import contact_sheet
from yolov5_lifecycle.collecting.drive_split import validation_drives, write_split
from yolov5_lifecycle.collecting.frame_list import FRAMES, MAX_LIST_BYTES, read_frame_list
from yolov5_lifecycle.collecting.merging import merge
from yolov5_lifecycle.collecting.overview import overview
from yolov5_lifecycle.collecting.own_files import CollectingError, own_bytes
from yolov5_lifecycle.collecting.record import FrameLine
from yolov5_lifecycle.evaluation.ground_truth import DataError
from yolov5_lifecycle.offline.collected.arguments import command_parser
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import complain, write_output

_COMMAND = "collected"
_NO_LIMIT = Quota(max_bytes=1 << 62, max_frames=1 << 62, min_free_bytes=0)


def main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)
    if arguments.action == "remove" and not (arguments.drive or arguments.reason):
        parser.error("remove needs --drive or --reason")
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
    return overview(line.frame for line in _lines(arguments.folder))


def _sheet(arguments: argparse.Namespace) -> str:
    folder = arguments.folder
    lines = sorted(_lines(folder), key=lambda line: -line.value)[: arguments.most]
    class_names = read_class_names(folder, is_used=False)
    with whole_output(arguments.output) as unfinished, unfinished.open("w", encoding="utf-8") as file:
        title = f"{len(lines)} collected images: {folder.resolve().name}"
        file.writelines(contact_sheet(folder, lines, class_names, title=title))
    return f"{arguments.output}: {len(lines)} images\n"


def _split(arguments: argparse.Namespace) -> str:
    folder, lines = arguments.folder, _lines(arguments.folder)
    validation = {*validation_drives(lines, arguments.share)}
    path = write_split(folder, lines, validation, read_class_names(folder, is_used=True))
    count = sum(line.drive in validation for line in lines)
    return f"{path}: {len(lines) - count} images for training, {count} for validation\n"


def _merge(arguments: argparse.Namespace) -> str:
    for folder in arguments.folders:
        _check(folder)
    with whole_output(arguments.output) as unfinished:
        count, repeated = merge(arguments.folders, unfinished)
    first = f"; {repeated} that a folder before had, too, are as in that one" if repeated else ""
    return f"{arguments.output}: {count} images{first}\n"


def _remove(arguments: argparse.Namespace) -> str:
    reasons, drives = {*arguments.reason}, {*arguments.drive}
    _check(arguments.folder)
    with closing(CollectedFolder(arguments.folder, _NO_LIMIT)) as folder:
        lines = folder.lines
        leaving = [
            line
            for line in lines
            if (not drives or line.drive in drives)
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
