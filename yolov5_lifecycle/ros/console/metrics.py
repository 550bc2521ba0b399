"""Metrics of all detectors in Prometheus' text format."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from yolov5_lifecycle.ros.console.detector import Detector

_PREFIX = "yolov5"
_STATES = ("unconfigured", "inactive", "active", "finalized")
_CAMERA = ("node", "camera")
_OF_CAMERA = {
    "rate Hz": ("rate_hertz", "Frames with detections per second"),
    "latency median ms": ("latency_median_milliseconds", "Median time from an image's arrival to its result"),
    "latency p95 ms": (
        "latency_p95_milliseconds",
        "95th percentile of the time from an image's arrival to its result",
    ),
    "frames lost": ("images_lost", "Images lost before they were received, since activation"),
    "frames overtaken": (
        "images_overtaken",
        "Images replaced by newer ones before they were received, since activation",
    ),
}
_OF_NODE = {
    "resident memory MB": ("resident_memory_megabytes", "Memory of the detector's process"),
    "abandoned threads": ("abandoned_threads", "Inference threads that hang"),
}
_OUTCOME = "frames "
_NO_COUNTERS = ("frames received", "frames pending", *_OF_CAMERA)
"""The sum of the outcomes, one that shrinks, and gauges."""


class _DetectorCollector(Collector):
    def __init__(self, detectors: Callable[[], Iterable[Detector]], viewers: Callable[[], int]) -> None:
        self._detectors = detectors
        self._viewers = viewers

    def collect(self) -> Iterator[Metric]:
        found = list(self._detectors())
        states = [((one.name, state), float(one.state == state)) for one in found for state in _STATES]
        yield _gauge("state", "1 for the current lifecycle state", ("node", "state"), states)
        nodes = [((one.name,), one.status) for one in found if one.status]
        for key, (name, text) in _OF_NODE.items():
            yield _gauge(name, text, ("node",), [(place, status.number(key)) for place, status in nodes])
        cameras = [((one.name, name), each) for one in found for name, each in one.cameras.items() if each]
        for key, (name, text) in _OF_CAMERA.items():
            yield _gauge(name, text, _CAMERA, [(place, status.number(key)) for place, status in cameras])
        levels = [(place, status.level) for place, status in cameras]
        yield _gauge("status_level", "Diagnostics: 0 OK, 1 WARN, 2 ERROR, 3 STALE", _CAMERA, levels)
        frames = CounterMetricFamily(f"{_PREFIX}_frames", "Frames by outcome", labels=[*_CAMERA, "outcome"])
        for place, status in cameras:
            for key in status.values:
                count = None if key in _NO_COUNTERS else status.number(key)
                if key.startswith(_OUTCOME) and count is not None:
                    frames.add_metric([*place, re.sub(r"\W", "_", key.removeprefix(_OUTCOME))], count)
        yield frames
        yield GaugeMetricFamily(f"{_PREFIX}_console_viewers", "Images being shown", self._viewers())


def figures(detectors: Callable[[], Iterable[Detector]], viewers: Callable[[], int]) -> Callable[[], bytes]:
    """A function that returns the current metrics of `detectors()`, as UTF-8."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_DetectorCollector(detectors, viewers))
    return lambda: bytes(generate_latest(registry))


def _gauge(
    name: str, text: str, labels: Sequence[str], samples: Iterable[tuple[Sequence[str], float | None]]
) -> Metric:
    """A gauge with those of `samples` that have a number."""
    gauge = GaugeMetricFamily(f"{_PREFIX}_{name}", text, labels=labels)
    for values, number in samples:
        if number is not None:
            gauge.add_metric(values, number)
    return gauge
