"""An exclusive ROS domain."""

from __future__ import annotations

from yolov5_lifecycle.ros.demo.domain import isolated, own_domain


def test_a_claimed_domain_is_nobody_elses() -> None:
    with own_domain() as first:
        with own_domain() as second:
            assert second != first
        with own_domain() as third:
            assert third != first


def test_an_isolated_process_keeps_its_environment_but_reaches_only_its_domain() -> None:
    reaches = {"ROS_DOMAIN_ID": "0", "ROS_STATIC_PEERS": "robot", "ROS_LOCALHOST_ONLY": "1"}
    environment = {"HOME": "/home/me"} | reaches
    kept = {"HOME": "/home/me", "ROS_DOMAIN_ID": "7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    assert isolated(environment, 7) == kept
