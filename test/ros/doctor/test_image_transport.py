"""Images from another process are counted by the numbers that their publisher gave them."""

from __future__ import annotations

import pytest
from sensor_msgs.msg import Image
from support.doctor_process import doctor

from yolov5_lifecycle.input_file import resolve_package
from yolov5_lifecycle.ros.doctor import environment as ros_environment
from yolov5_lifecycle.ros.doctor.started_nodes import Arrivals, has_foreign_segment
from yolov5_lifecycle.ros.shared_memory import PROFILE_VARIABLES

PROFILE = resolve_package(ros_environment.PROFILE)


def arrived(*numbers: int | None) -> Arrivals:
    arrivals = Arrivals()
    for number in numbers:
        arrivals.take(Image(), {"publication_sequence_number": number})
    return arrivals


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [((), 1.0), ((7,), 0.0), ((7, 8, 9), 0.0), ((7, 9), 1 / 3), ((1, 10), 0.8), ((None, None), 0.0)],
    ids=str,
)
def test_gaps_in_the_numbers_are_losses(numbers: tuple[int | None, ...], lost: float) -> None:
    assert arrived(*numbers).lost == pytest.approx(lost)


def test_the_line_has_losses_rate_latency_and_the_way() -> None:
    text = str(arrived(*range(30), *range(60, 90)))
    assert text.startswith("33% of the images of 1280x720 lost, 15.0 of 15 Hz received, ")
    assert text.endswith("ms each, without shared memory")


@pytest.mark.parametrize(
    ("mapped", "expected"),
    [
        pytest.param([], False, id="no shared memory"),
        pytest.param(["fastrtps_143cf107409bcd49"] * 2, False, id="its own"),
        pytest.param(
            ["fastrtps_143cf107409bcd49", "fastrtps_port7661", "lttng-ust-wait-6"], False, id="ports"
        ),
        pytest.param(["fastrtps_143cf107409bcd49", "fastrtps_4c55fdd7a32e4041"], True, id="another's"),
    ],
)
def test_a_segment_of_another_process_is_shared_memory(mapped: list[str], expected: bool) -> None:
    maps = "".join(f"7f2a-7f2b rw-s 00000000 00:19 5103  /dev/shm/{name}\n" for name in mapped)
    assert has_foreign_segment(maps) == expected


@pytest.mark.long  # a camera process, watched for seconds
@pytest.mark.parametrize(
    ("environment", "remedy"),
    [
        pytest.param({}, "Start cameras with `export FASTRTPS_DEFAULT_PROFILES_FILE=", id="by default"),
        pytest.param({PROFILE_VARIABLES[0]: PROFILE}, "Lower the camera's rate", id="with the profile"),
    ],
)
def test_the_way_of_the_images_is_told(environment: dict[str, str], remedy: str) -> None:
    (row,) = doctor("--only", "transport", "--time", "600", environment=environment)
    assert row.subject == "image transport"
    assert "of the images of 1280x720 lost" in row.found
    assert row.found.endswith("through shared memory")
    assert row.level == "ok" or row.remedy.startswith((remedy, "Lower the camera's rate"))
