"""Entry point of the command `camera`."""

from __future__ import annotations

from typing import NoReturn

from yolov5_lifecycle.ros.process_start import prepare_process, refuse_python
from yolov5_lifecycle.ros.shared_memory import warn_before_import


def main() -> NoReturn:
    """Prepare the process, import the node and run it; exit with code 1 if an import fails."""
    prepare_process("camera")
    warn_before_import("camera")

    try:
        from yolov5_lifecycle.ros.camera import node
    except ImportError as error:
        refuse_python("camera", error)
    node.main()
