"""The metrics of the console: their names, types, labels and units, which dashboards rely on."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from yolov5_lifecycle.ros.console.metrics import figures
from yolov5_lifecycle.ros.console.views import StatusView

NODE = StatusView(
    "detection", 0, "detecting", {"state": "active", "resident memory MB": "512", "abandoned threads": "0"}
)
FRONT = StatusView(
    "front",
    1,
    "slow",
    {
        "rate Hz": "9.5",
        "latency median ms": "20",
        "latency p95 ms": "31.5",
        "frames received": "12",
        "frames detected": "10",
        "frames flushed by a change": "1",
        "frames pending": "1",
        "frames lost": "2",
        "frames overtaken": "3",
        "last problem": "none",
    },
)
EXPECTED = """\
# TYPE yolov5_state gauge
yolov5_state{node="/yolov5",state="unconfigured"} 0.0
yolov5_state{node="/yolov5",state="inactive"} 0.0
yolov5_state{node="/yolov5",state="active"} 1.0
yolov5_state{node="/yolov5",state="finalized"} 0.0
# TYPE yolov5_resident_memory_megabytes gauge
yolov5_resident_memory_megabytes{node="/yolov5"} 512.0
# TYPE yolov5_abandoned_threads gauge
yolov5_abandoned_threads{node="/yolov5"} 0.0
# TYPE yolov5_rate_hertz gauge
yolov5_rate_hertz{camera="front",node="/yolov5"} 9.5
# TYPE yolov5_latency_median_milliseconds gauge
yolov5_latency_median_milliseconds{camera="front",node="/yolov5"} 20.0
# TYPE yolov5_latency_p95_milliseconds gauge
yolov5_latency_p95_milliseconds{camera="front",node="/yolov5"} 31.5
# TYPE yolov5_images_lost gauge
yolov5_images_lost{camera="front",node="/yolov5"} 2.0
# TYPE yolov5_images_overtaken gauge
yolov5_images_overtaken{camera="front",node="/yolov5"} 3.0
# TYPE yolov5_status_level gauge
yolov5_status_level{camera="front",node="/yolov5"} 1.0
# TYPE yolov5_frames_total counter
yolov5_frames_total{camera="front",node="/yolov5",outcome="detected"} 10.0
yolov5_frames_total{camera="front",node="/yolov5",outcome="flushed_by_a_change"} 1.0
# TYPE yolov5_console_viewers gauge
yolov5_console_viewers 4.0
"""


def test_metrics_keep_their_names_types_labels_and_units() -> None:
    detector: Any = SimpleNamespace(
        name="/yolov5", state="active", status=NODE, cameras={"front": FRONT, "rear": None}
    )
    text = figures(lambda: [detector], lambda: 4)().decode()
    found = [line for line in text.splitlines() if not line.startswith("# HELP")]
    assert found == EXPECTED.splitlines()
