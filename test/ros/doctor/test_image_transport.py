"""Images from another process are counted by the numbers that their publisher gave them."""

from __future__ import annotations

import pytest
from sensor_msgs.msg import Image
from support.doctor_process import doctor

from yolov5_lifecycle.ros.doctor.image_transport import Arrivals


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


@pytest.mark.long  # a camera process, watched for seconds
def test_the_way_of_the_images_is_told() -> None:
    (row,) = doctor(
        "--only", "transport", "--time", "600", environment={"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
    )
    assert row.subject == "image transport"
    assert "of the images of 1280x720 lost" in row.found
    assert row.found.endswith("without shared memory")
    (row,) = doctor("--only", "transport", "--time", "600")
    assert row.found.endswith("through shared memory")
