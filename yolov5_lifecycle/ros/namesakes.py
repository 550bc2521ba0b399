"""Other nodes of the same name, which ROS allows although services and parameters then reach either one."""

from __future__ import annotations

import os
import socket

from rclpy.node import Node

from yolov5_lifecycle.printable import in_one_line

_FAST_DDS = b"\x01\x0f"
"""A gid of Fast DDS begins with the number of its vendor, then has two bytes of the host."""


def namesakes(node: Node) -> str:
    """That other nodes have the name of `node`, where they are and what to do; "" if there are none."""
    own = node.get_name(), node.get_namespace()
    count = node.get_node_names_and_namespaces().count(own)
    if count < 2:
        return ""
    others = "another" if count == 2 else f"{count - 1} others"
    return (
        f"{count} nodes in this domain are named {node.get_fully_qualified_name()}: this one (host "
        f"{in_one_line(socket.gethostname())}, process {os.getpid()}) and {others} "
        f"({_where(node, own, count)}). Requests and parameters reach either of them. Restart one with "
        "`--ros-args -r __node:=another_name`. Every detector among them shows its host and process in "
        "/diagnostics; a killed one is listed for up to 20 s"
    )


def _where(node: Node, own: tuple[str, str], count: int) -> str:
    """On which machines the nodes named `own` are, as far as the graph tells: Fast DDS numbers them."""
    gids = [
        bytes(info.endpoint_gid)
        for info in node.get_publishers_info_by_topic("/parameter_events")
        if (info.node_name, info.node_namespace) == own
    ]
    if len(gids) < count or not all(gid.startswith(_FAST_DDS) for gid in gids):
        return "the graph does not tell on which host"
    return "on this host" if len({gid[2:4] for gid in gids}) == 1 else "not all on this host"
