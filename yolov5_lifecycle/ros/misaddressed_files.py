"""Parameter files on the command line that hold nothing for this node, which ROS passes over in silence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from yolov5_lifecycle.parameter_file import ParameterFileError, names_node, node_patterns

PARAMETER_FILE_FLAG = "--params-file"
_SHOWN_NAMES = 5


def warnings(arguments: Sequence[str], node_name: str) -> Iterator[str]:
    """One for each file that is written for other nodes alone; `node_name` with its namespace."""
    for flag, path in pairwise(arguments):
        names = _node_names(Path(path)) if flag == PARAMETER_FILE_FLAG else []
        if names and not any(names_node(name, node_name) for name in names):
            more = ", ..." if len(names) > _SHOWN_NAMES else ""
            yield (
                f"nothing in the parameter file {path} is obeyed: it is for {', '.join(names[:_SHOWN_NAMES])}"
                f"{more}, and this node is {node_name}. Write that, or /**, at its top."
            )


def _node_names(path: Path) -> list[str]:
    """The nodes that a file names; [] where it cannot be read, which is for ROS to tell."""
    if not path.is_file():  # a pipe has been emptied by ROS
        return []
    try:
        return node_patterns(path)
    except (OSError, ParameterFileError):
        return []
