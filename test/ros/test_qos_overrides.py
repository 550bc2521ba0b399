"""QoS overrides of a parameter file take effect on the topics they name, or are refused with the reason."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import Image
from support.colcon_workspace import REPOSITORY
from support.detector_process import NODE
from support.lone_node import lone_node
from support.preparations import Preparations
from support.served_node import ServedNode
from vision_msgs.msg import Detection3DArray

from yolov5_lifecycle.ros.topics import (
    full_name,
    published,
    qos_problems,
    subscribed,
)

PAGE = REPOSITORY / "docs" / "images.md"
CAMERA = "/camera/image_raw"
REMAP = ["--ros-args", "-r", f"~/image_raw:={CAMERA}"]
BEST_EFFORT = ReliabilityPolicy.BEST_EFFORT


def assignment(name: str, value: object) -> list[str]:
    return ["-p", f"qos_overrides.{name}:={value}"]


def test_qos_overrides_of_a_parameter_file_apply_in_every_cycle(ros_domain: int, tmp_path: Path) -> None:
    """Its words are those of docs/images.md; the camera itself is reliable."""
    file = tmp_path / "qos.yaml"
    (words,) = re.findall(r"^```yaml\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    file.write_text(words)
    arguments = [*REMAP, "--params-file", str(file), "-p", "lazy:=false"]
    with ServedNode(Preparations(), arguments=arguments) as served:
        client = served.client
        client.create_publisher(Image, CAMERA, 1)
        assert served.transition("configure")
        for _ in range(2):
            assert served.transition("activate")
            for infos, topic in (
                (client.get_subscriptions_info_by_topic, CAMERA),
                (client.get_publishers_info_by_topic, f"{NODE}/image"),
            ):
                served.wait_for(lambda: reliabilities(infos(topic)) == [BEST_EFFORT], f"{topic}")  # noqa: B023
            assert served.values()["image reliability"] == "best_effort"
            assert served.transition("deactivate")
        name = f"qos_overrides.{CAMERA}.subscription.reliability"
        assert served.get(name) == "best_effort"
        assert "read-only" in served.set(**{name: "reliable"})[1]


def reliabilities(infos: list[Any]) -> list[ReliabilityPolicy]:
    return [info.qos_profile.reliability for info in infos]


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        pytest.param(
            f"{CAMERA}.subscription.reliability", "relaible", "Did you mean 'reliable'", id="no such value"
        ),
        pytest.param(f"{CAMERA}.subscription.depth", 0, "0 is not an integer from 1", id="no depth"),
        pytest.param(f"{CAMERA}.subscription.depth", 10_001, "not an integer from 1 to", id="too deep"),
        pytest.param(f"{CAMERA}.subscription.durability", "volatile", "no such topic", id="other policy"),
        pytest.param(
            "/camara/image_raw.subscription.depth", 2, f"'qos_overrides.{CAMERA}.subs", id="mistyped topic"
        ),
        pytest.param(
            f"{CAMERA}.publisher.depth", 2, f"Did you mean 'qos_overrides.{CAMERA}", id="other side"
        ),
        pytest.param(
            "x.y", 2, f"Expected one of .*, {CAMERA}.subscription, .*each with history", id="nonsense"
        ),
    ],
)
def test_a_wrong_override_is_named_with_the_remedy(
    ros_domain: int, name: str, value: object, reason: str
) -> None:
    with lone_node("yolov5", *REMAP, *assignment(name, value)) as node:
        (problem,) = qos_problems(node, ("",))
        assert problem.setting == f"qos_overrides.{name}"
        assert re.search(reason, problem.message)
        assert problem.message.endswith("Correct it and restart the node.")


def test_every_topic_may_be_overridden_in_history_depth_and_reliability(ros_domain: int) -> None:
    with lone_node("yolov5", *REMAP) as node:
        names = [f"{full_name(node, topic)}.publisher" for topic in published(("",))]
        names += [f"{full_name(node, topic)}.subscription" for topic in subscribed(("",))]
    policies = {"history": "keep_all", "depth": 7, "reliability": "best_available"}
    pairs = [(f"{name}.{policy}", value) for name in names for policy, value in policies.items()]
    words = [word for pair in pairs for word in assignment(*pair)]
    arguments = [*REMAP, *words, "-p", "lazy:=false", "-p", "depth:=true"]
    with ServedNode(Preparations(), arguments=arguments) as served:
        served.client.create_subscription(Detection3DArray, f"{NODE}/detections_3d", lambda _: None, 1)
        served.bring_to("active")
        found = dict[str, tuple[str, int, str]]()

        def are_found(count: int) -> bool:
            found.update(qualities(served.node))
            return len(found.keys() & set(names)) == count

        served.wait_for(lambda: are_found(len(names) - 1), "all endpoints but that of the other transport")
        assert served.set(image_transport="compressed") == (True, "")
        served.wait_for(lambda: are_found(len(names)), "that endpoint")
        assert {found[name] for name in names} == {("KEEP_ALL", 7, "BEST_AVAILABLE")}


def qualities(node: Any) -> Iterator[tuple[str, tuple[str, int, str]]]:
    """History, depth and reliability of the endpoints of `node` by topic and kind."""
    for kind, endpoints in (("publisher", node.publishers), ("subscription", node.subscriptions)):
        for endpoint in list(endpoints):
            qos = endpoint.qos_profile
            yield f"{endpoint.topic_name}.{kind}", (qos.history.name, qos.depth, qos.reliability.name)


def test_the_setting_and_an_override_cannot_both_say_the_reliability(ros_domain: int) -> None:
    override = assignment(f"{CAMERA}.subscription.reliability", "reliable")
    arguments = [*REMAP, *override, "-p", "image_reliability:=best_effort"]
    with ServedNode(Preparations(), arguments=arguments) as served:
        assert not served.transition("configure")
        served.wait_for_log("both set the reliability of the subscription")
        assert served.set(image_reliability="auto") == (True, "")
        served.bring_to("active")
        assert "Use 'auto', or start without the override" in served.refusal(image_reliability="best_effort")
        assert served.set(image_transport="compressed") == (True, "")
        compressed = f"{CAMERA}/compressed"
        served.wait_for(lambda: served.client.count_subscribers(compressed) == 1, "the other transport")
