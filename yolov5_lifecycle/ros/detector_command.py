"""Command `detector`: the process is prepared, then the node is imported and run."""

from __future__ import annotations

from typing import NoReturn

from yolov5_lifecycle.ros.process_start import prepare_process


def main() -> NoReturn:
    prepare_process()

    from yolov5_lifecycle.ros import detector

    detector.main()
