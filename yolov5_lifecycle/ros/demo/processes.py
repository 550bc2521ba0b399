"""The processes of a demonstration: started in their own ROS domain, driven, and ended cleanly."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TypeVar

from yolov5_lifecycle.input_file import resolve_package
from yolov5_lifecycle.ros.demo.child_process import ChildProcess
from yolov5_lifecycle.ros.demo.domain import isolated, own_domain
from yolov5_lifecycle.ros.demo.driven_detector import DrivenDetector
from yolov5_lifecycle.ros.demo.observer import NoAnswerError, Observer
from yolov5_lifecycle.ros.demo.outcome import DemonstrationError

OUTPUT = Path("build/demo")
DETECTOR_PROCESS = "detector"

Result = TypeVar("Result")


def demonstrated(
    commands: Mapping[str, Sequence[str]],
    demonstrate: Callable[[Observer, DrivenDetector], Result],
    *,
    report: Callable[[str], None],
) -> Result:
    """Run `commands` by the names of their processes, the last of them DETECTOR_PROCESS, and `demonstrate`.

    Then shut the detector down and end all processes. Raises DemonstrationError, NoAnswerError, ProcessError,
    OSError or RuntimeError, also if a process does not end with exit code 0.
    """
    with own_domain() as domain, started(commands, domain) as processes:
        process_ids = [str(process.process_id) for process in processes]
        report(f"{_listed([*commands])} started as processes {_listed(process_ids)}")
        *cameras, detector = processes
        result = _driven(domain, processes, demonstrate, report)
        for process in (detector, *cameras):
            code = process.stop(signal.SIGINT)
            if code:
                raise DemonstrationError(f"the {process.name} ended with exit code {code} instead of 0")
        report(f"{'both' if len(processes) == 2 else 'all'} processes ended with exit code 0")
    return result


def project_file(path: str) -> Path:
    """`path` in the checkout that contains this file, else in the installed share folder."""
    checkout = Path(__file__).parents[3] / path
    return checkout if checkout.is_file() else Path(resolve_package(f"package://yolov5_lifecycle/{path}"))


def _driven(
    domain: int,
    processes: Sequence[ChildProcess],
    demonstrate: Callable[[Observer, DrivenDetector], Result],
    report: Callable[[str], None],
) -> Result:
    running = list(processes)
    detector = running[-1]

    def check() -> None:
        for process in running:
            process.check_running()

    try:
        with closing(Observer("demo", domain=domain, check=check)) as observer:
            driven = DrivenDetector(observer, report=report)
            result = demonstrate(observer, driven)
            # The process answers for a few more seconds, then ends.
            running.remove(detector)
            driven.transition("shutdown", "finalized")
    except (DemonstrationError, NoAnswerError) as error:
        raise DemonstrationError(f"{error}. The detector's last output:\n{detector.last_words}") from error
    return result


@contextmanager
def started(commands: Mapping[str, Sequence[str]], domain: int) -> Iterator[list[ChildProcess]]:
    """The processes of `commands` in the ROS domain `domain`; those still running at the end are killed."""
    OUTPUT.mkdir(parents=True, exist_ok=True)
    # Fast DDS needs shared memory that holds a whole image, here in all processes.
    environment = (
        {"AMENT_PREFIX_PATH": sys.prefix}
        | isolated(os.environ, domain)
        | {
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(project_file("config/shm.xml")),
            "ROS_LOG_DIR": str(OUTPUT.absolute() / "log"),
        }
    )
    os.environ.clear()
    os.environ.update(environment)
    with ExitStack() as stack:
        yield [
            stack.enter_context(ChildProcess(name, command, os.environ)) for name, command in commands.items()
        ]


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
