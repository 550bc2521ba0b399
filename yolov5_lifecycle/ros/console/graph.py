"""Which nodes of the ROS graph may be detectors."""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.node import Node

_SERVICES = ("get_state", "change_state", "get_available_transitions", "set_parameters_atomically")
_DIAGNOSTICS = "/diagnostics"


@dataclass(frozen=True)
class Candidate:
    """A managed node that publishes diagnostics; `publishers` identify the processes that have run it."""

    name: str
    publishers: frozenset[bytes]


def candidates(node: Node, names: tuple[str, ...]) -> list[Candidate]:
    """The managed nodes that `node` sees in the graph and that publish diagnostics, sorted by name.

    `names`: full names of the wanted ones; empty: all.
    """
    publishers: dict[str, set[bytes]] = {}
    for endpoint in node.get_publishers_info_by_topic(_DIAGNOSTICS):
        name = full_name(endpoint.node_name, endpoint.node_namespace)
        publishers.setdefault(name, set()).add(bytes(endpoint.endpoint_gid))
    wanted = {name: found for name, found in publishers.items() if name in names or not names}
    services = {name for name, _ in node.get_service_names_and_types()}
    return [
        Candidate(name, frozenset(found))
        for name, found in sorted(wanted.items())
        if services.issuperset(f"{name}/{service}" for service in _SERVICES)
    ]


def full_name(name: str, namespace: str) -> str:
    """`/robot/yolov5` of name and namespace."""
    return f"{namespace.rstrip('/')}/{name}"
