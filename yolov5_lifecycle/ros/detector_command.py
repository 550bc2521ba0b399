"""Command `detector`: the process is prepared, then the node is imported and run."""

from __future__ import annotations

from typing import NoReturn

from yolov5_lifecycle.ros.process_start import prepare_process, refuse_python


def main() -> NoReturn:
    """Prepare the process, import the node and run it; the code is 1 when something cannot be imported."""
    prepare_process()

    try:
        from yolov5_lifecycle.ros import detector
    except ImportError as error:
        refuse_python("detector", error)
    detector.main()
