"""Two nodes of one name in a domain are told, by each of them, with its host and process."""

from __future__ import annotations

import os
import socket
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.nodes import namesakes
from yolov5_lifecycle.ros.observer import Observer

HERE, THERE = b"\x01\x0f\x12\x34", b"\x01\x0f\x56\x78"
OWN = ("yolov5", "/robot")


def graph(*gids: bytes, names: int) -> Any:
    """A node among `names` of its name and one of another namespace, with `gids` of their publishers."""
    infos = [SimpleNamespace(node_name=OWN[0], node_namespace=OWN[1], endpoint_gid=gid) for gid in gids]
    return SimpleNamespace(
        get_name=lambda: OWN[0],
        get_namespace=lambda: OWN[1],
        get_fully_qualified_name=lambda: "/robot/yolov5",
        get_node_names_and_namespaces=lambda: [OWN] * names + [("yolov5", "/")],
        get_publishers_info_by_topic=lambda _: infos,
    )


@pytest.mark.parametrize(
    ("node", "told"),
    [
        pytest.param(graph(HERE, HERE, names=2), "and another (on this host)", id="same host"),
        pytest.param(graph(HERE, THERE, names=2), "and another (not all on this host)", id="other host"),
        pytest.param(graph(HERE, THERE, HERE, names=3), "and 2 others (not all on", id="three"),
        pytest.param(graph(HERE, names=2), "(the graph does not tell on which host)", id="unknown"),
        pytest.param(graph(b"\2", b"\3", names=2), "(the graph does not tell", id="another middleware"),
    ],
)
def test_each_says_where_it_is_and_where_the_others_are(node: Any, told: str) -> None:
    text = namesakes(node)
    assert f"named /robot/yolov5: this one (host {socket.gethostname()}, process {os.getpid()}) and" in text
    assert told in text


def test_the_only_node_of_its_name_says_nothing() -> None:
    assert namesakes(graph(HERE, names=1)) == ""


def test_a_detector_warns_in_any_state_while_another_node_has_its_name(ros_domain: int) -> None:
    with ServedNode(Preparations()) as served:
        assert "nodes in this domain" not in served.status().message
        with closing(Observer("yolov5", domain=ros_domain)):
            served.wait_for_log("2 nodes in this domain are named /yolov5: this one (host ")
            status = served.status()
            assert (status.level, "(on this host)" in status.message) == (DiagnosticStatus.WARN, True)
        served.wait_for(lambda: "nodes in this domain" not in served.status().message, "the other to leave")
