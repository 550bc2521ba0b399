"""Command `collected ACTION FOLDER`: what a detector has collected."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

from yolov5_lifecycle.atomic_file import OutputError, whole_output
from yolov5_lifecycle.collecting.class_list import read_class_names
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, CollectingError, Quota
from yolov5_lifecycle.collecting.contact_sheet import contact_sheet
from yolov5_lifecycle.collecting.drive_split import validation_drives, write_split
from yolov5_lifecycle.collecting.frame_list import FRAMES, read_frame_list
from yolov5_lifecycle.collecting.merging import merge
from yolov5_lifecycle.collecting.overview import overview
from yolov5_lifecycle.collecting.record import CollectedFrame
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


def _frames(folder: Path) -> tuple[CollectedFrame, ...]:
    """What is in `folder`; raises CollectingError if it is no folder of collected images."""
    if not (folder / FRAMES).is_file():
        raise CollectingError(f"{folder}: expected the collect_dir of a detector, found no {FRAMES} in it")
    return read_frame_list(folder).frames


def _show(arguments: argparse.Namespace) -> str:
    return overview(_frames(arguments.folder))


def _sheet(arguments: argparse.Namespace) -> str:
    frames = sorted(_frames(arguments.folder), key=lambda frame: -frame.value)[: arguments.most]
    with whole_output(arguments.output) as unfinished, unfinished.open("w", encoding="utf-8") as file:
        title = f"{len(frames)} collected images: {arguments.folder.resolve().name}"
        file.writelines(contact_sheet(arguments.folder, frames, title=title))
    return f"{arguments.output}: {len(frames)} images\n"


def _split(arguments: argparse.Namespace) -> str:
    folder, frames = arguments.folder, _frames(arguments.folder)
    validation = validation_drives(frames, arguments.share)
    path = write_split(folder, frames, validation, read_class_names(folder))
    count = sum(frame.drive in validation for frame in frames)
    return f"{path}: {len(frames) - count} images for training, {count} for validation\n"


def _merge(arguments: argparse.Namespace) -> str:
    for folder in arguments.folders:
        _frames(folder)
    with whole_output(arguments.output) as unfinished:
        count, repeated = merge(arguments.folders, unfinished)
    first = f"; {repeated} that a folder before had, too, are as in that one" if repeated else ""
    return f"{arguments.output}: {count} images{first}\n"


def _remove(arguments: argparse.Namespace) -> str:
    frames, reasons, drives = _frames(arguments.folder), {*arguments.reason}, {*arguments.drive}
    leaving = [
        frame
        for frame in frames
        if (not drives or frame.drive in drives) and (not reasons or reasons.issuperset(frame.reasons))
    ]
    with closing(CollectedFolder(arguments.folder, _NO_LIMIT)) as folder:
        for frame in leaving:
            folder.remove(frame)
    return f"{arguments.folder}: {len(leaving)} of {len(frames)} images removed\n"


_ACTIONS: Mapping[str, Callable[[argparse.Namespace], str]] = {
    "show": _show,
    "sheet": _sheet,
    "split": _split,
    "merge": _merge,
    "remove": _remove,
}
