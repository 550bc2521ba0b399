"""Parameter files on the command line that hold nothing for this node, which ROS passes over in silence."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import yaml

PARAMETER_FILE_FLAG = "--params-file"
_SHOWN_NAMES = 5
_WILDCARDS = {"/*": r"/\w+", "/**": r"(/\w+)*"}


def warnings(arguments: Sequence[str], node_name: str) -> Iterator[str]:
    """One for each file that is written for other nodes alone; `node_name` with its namespace."""
    for flag, path in pairwise(arguments):
        names = _node_names(Path(path)) if flag == PARAMETER_FILE_FLAG else []
        if names and not any(_means(name, node_name) for name in names):
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
        return list(_names_in(yaml.safe_load(path.read_bytes()), ""))
    except (OSError, ValueError, RecursionError, yaml.YAMLError):
        return []


def _names_in(tree: object, prefix: str) -> Iterator[str]:
    """Namespaces may be keys of their own."""
    for key, below in tree.items() if isinstance(tree, dict) else ():
        name = f"{prefix}/{str(key).strip('/')}"
        if isinstance(below, dict) and "ros__parameters" in below:
            yield name
        else:
            yield from _names_in(below, name)


def _means(name: str, node_name: str) -> bool:
    """Whether a name in a file, with the wildcards of ROS, is that of the node."""
    pattern = re.sub(r"/\*\*?", lambda wildcard: _WILDCARDS[wildcard[0]], name)
    return re.fullmatch(pattern, node_name) is not None
