"""A camera: one image of the device, which may also belong to something that sends none."""

from __future__ import annotations

import os
from collections.abc import Iterator

from yolov5_lifecycle.doctor.finding import Finding, Groups, Machine, error, ok, warning
from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.sources.source import open_source


def _camera(machine: Machine) -> Iterator[Finding]:
    device = machine.path(machine.target)
    if not os.access(device, os.R_OK | os.W_OK):
        yield error(
            "this user may not open it",
            remedy="Add the user to the group of the device with `sudo usermod -aG video $USER` and log in "
            "again; give a container the device with --device.",
        )
        return
    try:
        frame = next(open_source(str(device)).frames)
    except SourceError as problem:
        # The driver of USB cameras adds a second device, with the description of the images.
        if machine.text(f"/sys/class/video4linux/{device.name}/index").strip() not in ("", "0"):
            yield ok("sends no images: it belongs to another device of the same camera")
        else:
            yield warning(
                str(problem),
                remedy="End the program that uses the camera (`sudo fuser -v /dev/video*`), or plug it in "
                "again; ignore this line if the device is no camera.",
            )
        return
    height, width = frame.image.size_hw
    yield ok(f"one image of {width}x{height} received")


CHECKS: Groups = {"camera": {"camera": _camera}}
