"""Executable `demo`: starts camera and detector and drives them through every lifecycle transition."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Sequence

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.printable import in_report
from yolov5_lifecycle.ros.console.options import DEFAULT_PORT
from yolov5_lifecycle.ros.demo.child_process import ProcessError, entry_point
from yolov5_lifecycle.ros.demo.demonstration import Demonstration, Phase
from yolov5_lifecycle.ros.demo.driven_detector import DETECTOR
from yolov5_lifecycle.ros.demo.ground_truth import objects_per_class
from yolov5_lifecycle.ros.demo.image_file import saved
from yolov5_lifecycle.ros.demo.live import show_live
from yolov5_lifecycle.ros.demo.observer import NoAnswerError
from yolov5_lifecycle.ros.demo.outcome import DemonstrationError, Outcome, aligned
from yolov5_lifecycle.ros.demo.processes import DETECTOR_PROCESS, OUTPUT, demonstrated, project_file
from yolov5_lifecycle.ros.demo.several_cameras import FRAMES, demonstrate_cameras
from yolov5_lifecycle.sources.scene import CLASS_NAMES

SEED = 8


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demonstration; return 0 on success, 1 on a failure, 130 on an interrupt."""
    given = _arguments(argv)
    # On SIGTERM, the child processes must end as well.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    begun_s = time.monotonic()

    def report(text: str) -> None:
        _say(f"[{time.monotonic() - begun_s:5.1f} s] {text}")

    try:
        if given.console:
            show_live(commands(autostart=True), port=given.port, report=report)
            return 0
        outcome = (
            demonstrate_cameras(given.frames or FRAMES, report)
            if given.cameras
            else demonstrate_one_camera(report)
        )
    except (DemonstrationError, NoAnswerError, ProcessError, OSError, RuntimeError) as error:
        _say(f"demo failed: {error}")
        return 1
    except KeyboardInterrupt:
        _say("demo interrupted")
        return 130
    _say(outcome.table)
    if outcome.problems:
        _say("demo failed: " + "; ".join(outcome.problems))
        return 1
    _say("to watch it live in a browser: make console, or demo --console\n")
    _say(f"demo ok: {outcome.summary}, {time.monotonic() - begun_s:.0f} s")
    return 0


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(
        "demo",
        description="Run camera and detector as two processes and drive the detector through every lifecycle "
        f"transition. The last image is written to {OUTPUT}.",
    )
    parser.add_argument(
        "--cameras",
        action="store_true",
        help="run two cameras with depth on one detector instead: tracks and places in space, compared with "
        f"ground truth; image and figures are written to {OUTPUT}",
    )
    parser.add_argument(
        "--frames",
        type=int,
        metavar="N",
        help=f"with --cameras: number of images of each camera to compare (default {FRAMES})",
    )
    parser.add_argument(
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
    given = parser.parse_args(argv)
    if given.console and given.cameras:
        parser.error("--console and --cameras: expected one of them, found both")
    if given.frames is not None and (not given.cameras or given.frames < 2):
        parser.error(f"--frames: expected a number of at least 2, and --cameras, found {given.frames}")
    return given


def table(phases: Sequence[Phase]) -> str:
    """Table of the phases: frames, objects per class, recall, latencies."""
    heads = ["phase", "frames", *CLASS_NAMES, "recall", "median ms", "p95 ms"]
    return aligned([heads, *(_row(phase) for phase in phases)])


def _row(phase: Phase) -> list[str]:
    counts = objects_per_class(phase.sightings)
    found = "" if phase.recall != phase.recall else f"{phase.recall:.1%}"
    latencies = [f"{latency_ms:.1f}" for latency_ms in phase.latencies_ms]
    return [
        phase.name,
        str(len(phase.sightings)),
        *(str(counts[name]) for name in CLASS_NAMES),
        found,
        *latencies,
    ]


def commands(*, autostart: bool = False) -> dict[str, list[str]]:
    """Command lines of camera and detector by the names of their processes."""
    camera_arguments = ["--ros-args", "-p", f"seed:={SEED}", "-r", f"image_raw:={DETECTOR}/image_raw"]
    detector_arguments = ["--ros-args", "--params-file", str(project_file("config/demo.yaml"))]
    if autostart:
        detector_arguments += ["-p", "autostart:=true"]
    return {
        "camera": [entry_point("camera"), *camera_arguments],
        DETECTOR_PROCESS: [entry_point("detector"), *detector_arguments],
    }


def demonstrate_one_camera(report: Callable[[str], None]) -> Outcome:
    """Run the demonstration; writes the image below OUTPUT. Raises what `demonstrated` raises."""
    found = demonstrated(
        commands(),
        lambda observer, detector: Demonstration(observer, detector, report=report).run(),
        report=report,
    )
    path = saved(found.annotated, OUTPUT / "annotated.png")
    first = found.phases[0]
    summary = (
        f"{len(first.sightings)} frames watched, {first.recall:.1%} of the shapes found, "
        f"mask IoU {found.mask_iou:.2f}, median latency {first.latencies_ms[0]:.0f} ms, image in {path}"
    )
    return Outcome(table(found.phases), summary)


def _say(text: str) -> None:
    sys.stdout.write(in_report(text) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
