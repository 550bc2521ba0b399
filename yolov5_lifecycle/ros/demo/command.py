"""Executable `demo`: starts camera and detector and drives them through every lifecycle transition."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import cv2
from ament_index_python.packages import get_package_share_directory

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.demo.child_process import ChildProcess, ProcessError, entry_point
from yolov5_lifecycle.ros.demo.demonstration import Demonstration, DemonstrationError, Phase
from yolov5_lifecycle.ros.demo.domain import isolated, own_domain
from yolov5_lifecycle.ros.demo.ground_truth import objects_per_class
from yolov5_lifecycle.ros.demo.observer import NoAnswerError, Observer, RemoteLifecycleNode
from yolov5_lifecycle.sources.scene import CLASS_NAMES

OUTPUT = Path("build/demo")
SEED = 8
_END_S = 10.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demonstration; return 0 on success, 1 on a failure, 130 on an interrupt."""
    CommandParser(
        "demo",
        description="Run camera and detector as two processes and drive the detector through every lifecycle "
        f"transition. The last image is written to {OUTPUT}; there are no options.",
    ).parse_args(argv)
    # On SIGTERM, the child processes must end as well.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    begun_s = time.monotonic()
    try:
        phases, image_path = _run(lambda text: _say(f"[{time.monotonic() - begun_s:5.1f} s] {text}"))
    except (DemonstrationError, NoAnswerError, ProcessError, OSError, RuntimeError) as error:
        _say(f"demo failed: {error}")
        return 1
    except KeyboardInterrupt:
        _say("demo interrupted")
        return 130
    _say(table(phases))
    first = phases[0]
    _say(
        f"demo ok: {len(first.sightings)} frames watched, {first.recall:.1%} of the shapes found, "
        f"median latency {first.latencies_ms[0]:.0f} ms, image in {image_path}, "
        f"{time.monotonic() - begun_s:.0f} s"
    )
    return 0


def table(phases: Sequence[Phase]) -> str:
    """Table of the phases: frames, objects per class, recall, latencies."""
    heads = ["phase", "frames", *CLASS_NAMES, "recall", "median ms", "p95 ms"]
    rows = [heads, *(_row(phase) for phase in phases)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(heads))]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows
    ]
    return "\n".join(["", lines[0], "-" * len(lines[0]), *lines[1:], ""])


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


def _run(report: Callable[[str], None]) -> tuple[list[Phase], Path]:
    with own_domain() as domain, _processes(domain) as (camera, detector):
        report(f"camera and detector started as processes {camera.process_id} and {detector.process_id}")
        running = [camera, detector]

        def check() -> None:
            for process in running:
                process.check_running()

        try:
            with closing(Observer("demo", domain=domain, check=check)) as observer:
                demonstration = Demonstration(
                    observer, RemoteLifecycleNode(observer, "/yolov5"), report=report
                )
                phases, annotated = demonstration.run()
                running.remove(detector)
                demonstration.shut_down()
        except (DemonstrationError, NoAnswerError) as error:
            raise DemonstrationError(f"{error}. The detector's last words:\n{detector.last_words}") from error
        _expect_clean_end("detector", detector.stop(signal.SIGINT, timeout_s=_END_S))
        _expect_clean_end("camera", camera.stop(signal.SIGINT, timeout_s=_END_S))
        report("both processes ended with exit code 0")
    return phases, _saved(annotated)


@contextmanager
def _processes(domain: int) -> Iterator[tuple[ChildProcess, ChildProcess]]:
    OUTPUT.mkdir(parents=True, exist_ok=True)
    # Fast DDS needs shared memory that holds a whole image, here in all three processes.
    environment = (
        {"AMENT_PREFIX_PATH": sys.prefix}
        | isolated(os.environ, domain)
        | {
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(_project_file("config/shm.xml")),
            "ROS_LOG_DIR": str(OUTPUT.absolute() / "log"),
        }
    )
    os.environ.clear()
    os.environ.update(environment)
    camera_arguments = ["--ros-args", "-p", f"seed:={SEED}", "-r", "image_raw:=/yolov5/image_raw"]
    camera_command = [entry_point("camera"), *camera_arguments]
    parameter_file = str(_project_file("config/demo.yaml"))
    detector_command = [entry_point("detector"), "--ros-args", "--params-file", parameter_file]
    with ExitStack() as stack:
        camera = stack.enter_context(ChildProcess("camera", camera_command, os.environ))
        detector = stack.enter_context(ChildProcess("detector", detector_command, os.environ))
        yield camera, detector


def _project_file(path: str) -> Path:
    """`path` in the checkout that contains this file, else in the installed share folder."""
    checkout = Path(__file__).parents[2] / path
    return checkout if checkout.is_file() else Path(get_package_share_directory("yolov5_lifecycle")) / path


def _expect_clean_end(name: str, code: int) -> None:
    if code:
        raise DemonstrationError(f"the {name} ended with exit code {code} instead of 0")


def _saved(annotated: ColourImage) -> Path:
    path = OUTPUT / "annotated.png"
    pixels = annotated.pixels if annotated.order == "bgr" else annotated.pixels[..., ::-1]
    if not cv2.imwrite(str(path), pixels):
        raise OSError(f"{path} cannot be written")
    return path


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
