"""Warnings for parameter files without a section for this node, which ROS ignores silently."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from yolov5_lifecycle.ros.start_arguments import ParameterFile
from yolov5_lifecycle.settings.parameter_file import names_node

_SHOWN_NAMES = 5


def warnings(files: Iterable[ParameterFile], node_name: str) -> Iterator[str]:
    """Yield one warning per file that names only other nodes; `node_name` is fully qualified."""
    for file in files:
        names = list(file.nodes)
        if names and not any(names_node(name, node_name) for name in names):
            more = ", ..." if len(names) > _SHOWN_NAMES else ""
            yield (
                f"nothing in the parameter file {file.path} takes effect: it is for "
                f"{', '.join(names[:_SHOWN_NAMES])}{more}, and this node is {node_name}. Write that, or /**, "
                "at its top."
            )
