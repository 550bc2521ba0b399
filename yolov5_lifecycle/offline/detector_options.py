"""Command-line options that configure the detector of a command, and the settings they give."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.commands.command_line import node_name
from yolov5_lifecycle.settings.parameter_file import assigned_value, file_values
from yolov5_lifecycle.settings.schema import SEPARATOR, Problem, SettingsError
from yolov5_lifecycle.settings.settings import Settings, validated

_OF_THE_NODE = ("autostart", "bond_timeout", "image_reliability", "image_transport", "lazy", "max_rate")
"""Settings without effect offline; a parameter file may contain them, command-line arguments may not."""
_NOT_OFFLINE = "it applies to a node that receives images; here every image is read from a file."


def wanted_settings(
    parameter_file: Path | None, assignments: Sequence[str], node: str, camera: str | None = None
) -> Settings:
    """Settings of the node named `node`: the parameter file, overridden by `name=value` assignments.

    `camera`: which of its `cameras` the settings are for. Raises SettingsError with the problems of all
    values, ParameterFileError and OSError.
    """
    values = file_values(parameter_file, node) if parameter_file else {}
    assigned = dict(map(assigned_value, assignments))
    problems = [Problem(name, _NOT_OFFLINE) for name in _OF_THE_NODE if name in assigned]
    try:
        settings = validated(values | {name: assigned[name] for name in assigned if name not in _OF_THE_NODE})
        wanted = _of_camera(settings, camera)
    except SettingsError as error:
        raise SettingsError([*problems, *error.problems]) from None
    if problems:
        raise SettingsError(problems)
    return wanted


def _of_camera(settings: Settings, camera: str | None) -> Settings:
    """`settings` of that camera, or, without one, if they are the same for all; raises SettingsError."""
    if camera is not None:
        if camera in settings.cameras:
            return settings.for_camera(camera)
        known = ", ".join(settings.cameras)
        expected = f"expected one of {known}" if known else "there are no cameras"
        raise SettingsError([Problem("cameras", f"{expected}, but --camera is {camera!r}.")])
    choices = " or ".join(f"--camera {name}" for name in settings.cameras)
    problems = [
        Problem(name, f"it applies to one camera only: give the one that took the images, {choices}.")
        for name in settings.overrides
        if name.rpartition(SEPARATOR)[2] not in _OF_THE_NODE
    ]
    if problems:
        raise SettingsError(problems)
    return settings


def add_detector_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that `wanted_settings` turns into settings."""
    parser.add_argument(
        "--params-file", type=Path, metavar="FILE.yaml", help="parameter file of the detector"
    )
    parser.add_argument(
        *("--set", "-p"),
        action="append",
        default=[],
        type=_assignment,
        dest="assignments",
        metavar="NAME=VALUE",
        help="a parameter of the detector, overrides the file; may be repeated, and be NAME:=VALUE",
    )
    parser.add_argument(
        "--node",
        type=node_name,
        default="/yolov5",
        help="name of the detector in the parameter file and in topics (default: %(default)s)",
    )
    parser.add_argument(
        "--camera", metavar="NAME", help="the camera, of the parameter `cameras`, that took the images"
    )


def _assignment(text: str) -> str:
    """Convert `NAME:=VALUE`, as after --ros-args, to `NAME=VALUE`."""
    name, equals, value = text.partition("=")
    return f"{name.removesuffix(':')}{equals}{value}"
