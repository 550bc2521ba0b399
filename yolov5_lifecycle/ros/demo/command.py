"""Executable `demo`: drives a detector with one or two cameras, and compares it with the truth."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Sequence

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.printable import in_report
from yolov5_lifecycle.ros.console.options import DEFAULT_PORT
from yolov5_lifecycle.ros.demo.demonstrations import ONE_CAMERA, TWO_CAMERAS, one_camera, two_cameras
from yolov5_lifecycle.ros.demo.stage import OUTPUT, DemonstrationError, Report, show_live, stage


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demonstration; return 0 on success, 1 on a failure, 130 on an interrupt."""
    given = _arguments(argv)
    # On SIGTERM, the child processes must end as well.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    begun_s = time.monotonic()
    try:
        summary = _run(given, lambda text: _say(f"[{time.monotonic() - begun_s:5.1f} s] {text}"))
    except (DemonstrationError, OSError, RuntimeError) as error:
        _say(f"demo failed: {error}")
        return 1
    except KeyboardInterrupt:
        _say("demo interrupted")
        return 130
    if summary:
        _say("\nto watch it live in a browser: make console, or demo --console\n")
        _say(f"demo ok: {summary}, {time.monotonic() - begun_s:.0f} s")
    return 0


def _run(given: argparse.Namespace, report: Report) -> str:
    """The summary of the demonstration; "" for one that a user watched."""
    if given.console:
        detector = f"{ONE_CAMERA['detector']} -p autostart:=true"
        show_live({**ONE_CAMERA, "detector": detector}, port=given.port, report=report)
        return ""
    commands, demonstrate = (TWO_CAMERAS, two_cameras) if given.cameras else (ONE_CAMERA, one_camera)
    with stage(commands, report) as driven:
        return demonstrate(driven)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(
        "demo",
        description="Run camera and detector as two processes and drive the detector through every lifecycle "
        f"transition. An image is written to {OUTPUT}.",
    )
    way = parser.add_mutually_exclusive_group()
    way.add_argument(
        "--cameras",
        action="store_true",
        help="run two cameras with depth on one detector instead: tracks and places in space",
    )
    way.add_argument(
        "--console",
        action="store_true",
        help="run camera, detector and console until Ctrl-C instead; prints the address for the browser",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=DEFAULT_PORT,
        help="with --console: its port (default %(default)s; 0: any free one)",
    )
    return parser.parse_args(argv)


def _say(text: str) -> None:
    sys.stdout.write(in_report(text) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
