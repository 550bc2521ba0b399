"""`doctor` in a terminal whose ROS is set up wrongly says what is wrong and what helps."""

from __future__ import annotations

from pathlib import Path

import pytest
from sensor_msgs.msg import Image
from support.doctor_process import doctor, first_on_path, of, planted

from yolov5_lifecycle.doctor.finding import Finding, Machine
from yolov5_lifecycle.input_file import resolve_package
from yolov5_lifecycle.ros.doctor.environment import CHECKS, PROFILE
from yolov5_lifecycle.ros.doctor.started_nodes import Arrivals
from yolov5_lifecycle.ros.shared_memory import PROFILE_VARIABLES

SUBJECTS = ["middleware", "discovery", "shared memory", "ROS"]
WRONG = {
    "RMW_IMPLEMENTATION": "rmw_nothing_cpp",
    "FASTRTPS_DEFAULT_PROFILES_FILE": "/nowhere/shm.xml",
    "CYCLONEDDS_URI": "file:///nowhere/dds.xml",
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    "ROS_DOMAIN_ID": "233",
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "subnet",
    "ROS_LOCALHOST_ONLY": "1",
}
"""Every variable, each in a way of its own."""


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[Finding]:
    """The report of a terminal with all of them, on a machine without /dev/shm."""
    return doctor("--only", "ros", environment=WRONG, root=tmp_path_factory.mktemp("root"))


@pytest.mark.parametrize(
    ("subject", "level", "found", "remedy"),
    [
        pytest.param(
            *("middleware", "error", "RMW_IMPLEMENTATION is rmw_nothing_cpp, installed are rmw_"),
            "sudo apt install ros-jazzy-rmw-nothing-cpp",
            id="middleware",
        ),
        pytest.param(
            *("middleware", "error", "FASTRTPS_DEFAULT_PROFILES_FILE is /nowhere/shm.xml, which is no file"),
            "unset FASTRTPS_DEFAULT_PROFILES_FILE",
            id="profile of Fast DDS",
        ),
        pytest.param(
            *("middleware", "error", "CYCLONEDDS_URI is /nowhere/dds.xml", "unset CYCLONEDDS_URI"),
            id="settings of Cyclone DDS",
        ),
        pytest.param(
            *("middleware", "warning", "is UDPv4: images go over UDP", "unset FASTDDS_BUILTIN_TRANSPORTS"),
            id="transports",
        ),
        pytest.param(
            *("discovery", "error", "ROS_DOMAIN_ID is 233: no node can start", "from 0 to 101"), id="domain"
        ),
        pytest.param(
            *("discovery", "error", "is subnet, which means LOCALHOST to ROS", "one of SUBNET, LOCALHOST"),
            id="range",
        ),
        pytest.param(
            *("discovery", "warning", "overrides the discovery range", "unset ROS_LOCALHOST_ONLY"),
            id="the old variable",
        ),
        pytest.param(*("shared memory", "warning", "/dev/shm does not exist", "--ipc=host"), id="/dev/shm"),
        pytest.param(
            *("ROS", "error", "Expected RMW implementation identifier", "Correct the errors above first"),
            id="the process ends",
        ),
    ],
)
def test_what_is_wrong_is_found(
    rows: list[Finding], subject: str, level: str, found: str, remedy: str
) -> None:
    (row,) = [row for row in rows if row.subject == subject and found in row.found]
    assert row.level == level
    assert remedy in row.remedy


def test_a_process_that_ends_hides_no_other_check(rows: list[Finding]) -> None:
    assert list(dict.fromkeys(row.subject for row in rows)) == SUBJECTS


@pytest.mark.parametrize(
    ("domain", "level"),
    [
        *(("", "ok"), ("232", "ok"), ("233", "error")),
        *(("-1", "error"), ("two", "error"), ("9" * 30, "error")),
    ],
)
def test_a_domain_has_limits(domain: str, level: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    (finding,) = CHECKS["ros"]["discovery"](Machine())
    assert finding.level == level


def test_no_discovery_two_distributions_and_settings_as_text_are_told() -> None:
    wrong = {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF",
        "ROS_DISTRO": "humble",
        "CYCLONEDDS_URI": "<CycloneDDS/>",
    }
    rows = doctor("--only", "ros", environment=wrong)
    assert of(rows, "middleware").level == "ok"
    row = of(rows, "discovery")
    assert (row.level, "nodes do not find each other" in row.found) == ("warning", True)
    row = of(rows, "ROS")
    assert (row.level, "but ROS_DISTRO is humble" in row.found) == ("error", True)
    assert "one ROS is sourced" in row.remedy


def test_a_full_dev_shm_is_found(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev" / "shm").symlink_to("/proc")  # a file system without a free byte
    (finding,) = CHECKS["ros"]["shared memory"](Machine(tmp_path))
    assert finding.level == "warning"
    assert "has 0 KiB free and Fast DDS needs 656 KiB" in finding.found
    assert finding.remedy.startswith("Give the container more")


def test_a_python_without_ros_is_told_to_source_it(tmp_path: Path) -> None:
    absent = "raise ModuleNotFoundError(\"No module named 'rclpy'\", name='rclpy')"
    planted(tmp_path, {"rclpy/__init__.py": absent})
    rows = doctor("--only", "ros", "transport", "node", environment=first_on_path(tmp_path))
    for subject in ("ROS", "transport", "node"):
        row = of(rows, subject)
        assert "No module named 'rclpy'" in row.found
        assert "source /opt/ros/jazzy/setup.bash" in row.found + row.remedy


# Images from another process, counted by the numbers that their publisher gave them


def arrived(*numbers: int | None) -> Arrivals:
    arrivals = Arrivals()
    for number in numbers:
        arrivals.take(Image(), {"publication_sequence_number": number})
    return arrivals


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [((), 1.0), ((7,), 0.0), ((7, 9), 1 / 3), ((1, 10), 0.8), ((None, None), 0.0)],
    ids=str,
)
def test_gaps_in_the_numbers_are_losses(numbers: tuple[int | None, ...], lost: float) -> None:
    assert arrived(*numbers).lost == pytest.approx(lost)


def test_the_line_has_losses_rate_and_latency() -> None:
    text = str(arrived(*range(30), *range(60, 90)))
    assert text.startswith("33% of the images of 1280x720 lost, 15.0 of 15 Hz received, ")
    assert text.endswith(" ms each")


@pytest.mark.long  # a camera process, watched for seconds
@pytest.mark.parametrize(
    ("environment", "remedy"),
    [
        pytest.param({}, "Start cameras with `export FASTRTPS_DEFAULT_PROFILES_FILE=", id="by default"),
        pytest.param({PROFILE_VARIABLES[0]: resolve_package(PROFILE)}, "Lower the", id="with the profile"),
    ],
)
def test_the_way_of_the_images_is_told(environment: dict[str, str], remedy: str) -> None:
    (row,) = doctor("--only", "transport", "--time", "600", environment=environment)
    assert row.subject == "image transport"
    assert "of the images of 1280x720 lost" in row.found
    assert row.level == "ok" or row.remedy.startswith((remedy, "Lower the camera's rate"))
