"""Metrics of all detectors in Prometheus' text format."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from yolov5_lifecycle.ros.console.detector import Detector
from yolov5_lifecycle.ros.console.views import StatusView

STATES = ("unconfigured", "inactive", "active", "finalized")
_PREFIX = "yolov5"
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


class _DetectorCollector(Collector):
    def __init__(self, detectors: Callable[[], Iterable[Detector]], viewers: Callable[[], int]) -> None:
        self._detectors = detectors
        self._viewers = viewers

    def collect(self) -> Iterator[Metric]:
        detectors = list(self._detectors())
        yield _states(detectors)
        yield from _node_gauges(detectors)
        yield from _camera_metrics(detectors)
        yield GaugeMetricFamily(f"{_PREFIX}_console_viewers", "Images being shown", self._viewers())


def figures(detectors: Callable[[], Iterable[Detector]], viewers: Callable[[], int]) -> Callable[[], bytes]:
    """A function that returns the current metrics of `detectors()`, as UTF-8."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_DetectorCollector(detectors, viewers))
    return lambda: bytes(generate_latest(registry))


def _states(detectors: Iterable[Detector]) -> Metric:
    metric = GaugeMetricFamily(
        f"{_PREFIX}_state", "1 for the current lifecycle state", labels=["node", "state"]
    )
    for detector in detectors:
        for state in STATES:
            metric.add_metric([detector.name, state], float(detector.state == state))
    return metric


def _node_gauges(detectors: Iterable[Detector]) -> Iterator[Metric]:
    for key, (name, text) in _OF_NODE.items():
        metric = GaugeMetricFamily(f"{_PREFIX}_{name}", text, labels=["node"])
        for detector in detectors:
            if detector.status and (number := detector.status.number(key)) is not None:
                metric.add_metric([detector.name], number)
        yield metric


def _camera_metrics(detectors: Iterable[Detector]) -> Iterator[Metric]:
    labels = ["node", "camera"]
    statuses = [
        ([detector.name, camera], status)
        for detector in detectors
        for camera, status in detector.cameras
        if status is not None
    ]
    for key, (name, text) in _OF_CAMERA.items():
        gauge = GaugeMetricFamily(f"{_PREFIX}_{name}", text, labels=labels)
        for place, status in statuses:
            if (number := status.number(key)) is not None:
                gauge.add_metric(place, number)
        yield gauge
    level = GaugeMetricFamily(
        f"{_PREFIX}_status_level", "Diagnostics: 0 OK, 1 WARN, 2 ERROR, 3 STALE", labels=labels
    )
    frames = CounterMetricFamily(f"{_PREFIX}_frames", "Frames by outcome", labels=[*labels, "outcome"])
    for place, status in statuses:
        level.add_metric(place, status.level)
        for outcome, count in _outcomes(status):
            frames.add_metric([*place, outcome], count)
    yield from (level, frames)


def _outcomes(status: StatusView) -> Iterator[tuple[str, int]]:
    """The counts that only grow: without pending frames, and without `received`, their sum."""
    for outcome, count in status.balance.items():
        if outcome not in ("received", "pending"):
            yield re.sub(r"\W", "_", outcome), count
