"""The figures of `make bench` for several cameras: what is compared, and how they share a node."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest
from sensor_msgs.msg import Image
from support.colcon_workspace import REPOSITORY

from benchmark.camera_fleet import LAYOUTS, Arrival, Layout, Passage, active_fleet
from benchmark.cameras import layout_goals, layout_rows, ratios_of
from benchmark.fairness import (
    equal_shares,
    others_rates,
    overtaking,
    share_deviation_percent,
    slow_beside_fast,
)
from benchmark.misbehaving_camera import unreadable_images
from benchmark.node import image_file
from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.ros.messages import image_of_message

pytestmark = pytest.mark.long

WEIGHTS = REPOSITORY / "weights" / "shapes.safetensors"
IMAGE_HW = (96, 128)
CAMERAS = ("left", "right")
MS = 1_000_000


@pytest.mark.usefixtures("_environment")
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_camera_of_a_layout_is_watched(layout: Layout, tmp_path: Path) -> None:
    image = image_file(IMAGE_HW, tmp_path)
    fleet_of = active_fleet(layout, CAMERAS, weights=WEIGHTS, cache=tmp_path, image_size=128)
    with fleet_of as fleet, ExitStack() as stack:
        for name in CAMERAS:
            stack.enter_context(fleet.camera(name, image, rate_hz=10.0))
        fleet.wait_for(CAMERAS)
        passage = fleet.watch(CAMERAS, 2.0)
    assert passage.counts.keys() == {*CAMERAS}
    assert min(passage.latencies_ms) > 0
    assert passage.cpu_s > 0
    assert 50 < passage.proportional_mb <= passage.resident_mb


@pytest.mark.usefixtures("_environment")
def test_cameras_that_share_a_node_are_judged(tmp_path: Path) -> None:
    image, names = image_file(IMAGE_HW, tmp_path), CAMERAS
    with active_fleet("one node", names, weights=WEIGHTS, cache=tmp_path, image_size=128) as fleet:
        total_hz, _, shares = equal_shares(fleet, names, image, rate_hz=10.0, duration_s=2.0)
        _, delays = slow_beside_fast(fleet, CAMERAS, image, rates_hz=(5.0, 50.0), passages=[2.0])
        rows, changes = others_rates(fleet, names, image, rate_hz=5.0, passages=[2.0])
    assert total_hz > 0
    assert len(shares) == 1
    assert len(delays) == 2
    assert len(changes) == len(rows) - 1
    assert min(row.median for row in rows) > 0


def arrivals(*seen: tuple[str, int, int]) -> list[Arrival]:
    """Of camera, stamp and receipt in milliseconds."""
    return [Arrival(camera, stamp_ms * MS, received_ms * MS) for camera, stamp_ms, received_ms in seen]


def passage(*, latencies_ms: Sequence[int], cpu_s: float, memory_mb: float) -> Passage:
    """Of one camera in two seconds."""
    seen = arrivals(*(("left", 0, latency_ms) for latency_ms in latencies_ms))
    return Passage(seen, 2.0, cpu_s, memory_mb, 2 * memory_mb)


def test_a_younger_image_that_is_served_before_a_slow_one_has_overtaken_it() -> None:
    seen = arrivals(
        ("fast", 5, 20),
        ("slow", 10, 40),
        ("fast", 15, 60),
        ("fast", 50, 70),
        ("fast", 55, 80),
        ("slow", 52, 90),
    )
    assert overtaking(seen, "slow") == [0, 1]


@pytest.mark.parametrize(
    ("counts", "percent"),
    [
        pytest.param([50, 50, 50], 0.0, id="equal"),
        pytest.param([45, 50, 48], 10.0, id="unequal"),
        pytest.param([0, 50], 100.0, id="one gets nothing"),
        pytest.param([0, 0], 100.0, id="nothing"),
    ],
)
def test_shares_deviate_by_the_smallest_from_the_largest(counts: list[int], percent: float) -> None:
    assert share_deviation_percent(counts) == pytest.approx(percent)


def test_ratios_are_those_of_each_round() -> None:
    one_node = [passage(latencies_ms=[10, 20, 30], cpu_s=0.3, memory_mb=100.0)]
    a_node_each = [passage(latencies_ms=[40, 40], cpu_s=0.4, memory_mb=400.0)]
    ratios = ratios_of(one_node, a_node_each)
    assert ratios["detections"] == [1.5]
    assert ratios["median"] == [0.5]
    assert ratios["p95"] == [0.75]
    assert ratios["CPU"] == [0.5]
    assert ratios["PSS"] == ratios["RSS"] == [0.25]


@pytest.mark.parametrize(
    ("changed", "missed"),
    [
        pytest.param({}, 0, id="all reached"),
        pytest.param({"detections": 0.9}, 1, id="fewer detections"),
        pytest.param({"PSS": 0.5, "p95": 1.1}, 2, id="more memory, later"),
    ],
)
def test_the_goals_of_layouts_compare_one_node_with_a_node_each(
    changed: dict[str, float], missed: int
) -> None:
    goals = layout_goals({"detections": 1.2, "PSS": 0.35, "p95": 0.8} | changed)
    assert sum(not goal.is_reached for goal in goals) == missed


def test_the_rows_of_a_layout_have_the_latencies_of_all_passages() -> None:
    passed = [passage(latencies_ms=[10, 20], cpu_s=0.3, memory_mb=100.0) for _ in range(2)]
    rows = {row.name: row for row in layout_rows("one node", 4, passed)}
    assert rows["one node, latency"].median == 15.0
    assert rows["one node, detections"].median == 1.0
    assert rows["one node, CPU"].median == pytest.approx(15.0)


def test_the_garbage_of_a_misbehaving_camera_is_unreadable() -> None:
    height, width = IMAGE_HW
    whole = Image(height=height, width=width, step=3 * width, encoding="bgr8")
    whole.data = array("B", bytes(3 * height * width))
    image_of_message(whole)
    for message in unreadable_images(whole):
        with pytest.raises(ImageError):
            image_of_message(message)
