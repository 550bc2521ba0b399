"""Entry point of the command `camera`."""

from __future__ import annotations

from typing import NoReturn

from yolov5_lifecycle.ros.process_start import prepare_node_process, refuse_python


def main() -> NoReturn:
    """Prepare the process, import the node and run it; exit with code 1 if an import fails."""
    prepare_node_process("camera")
    try:
        from yolov5_lifecycle.ros.camera import node
    except ImportError as error:
        refuse_python("camera", error)
    node.main()
