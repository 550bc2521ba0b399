"""Metrics of all detectors in Prometheus' text format."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from yolov5_lifecycle.ros.console.detector import Detector


class _DetectorCollector(Collector):
    def __init__(self, detectors: Callable[[], Iterable[Detector]]) -> None:
        self._detectors = detectors

    def collect(self) -> Iterable[Metric]:
        state = GaugeMetricFamily("yolov5_state", "1: the lifecycle state", labels=("node", "state"))
        level = GaugeMetricFamily(
            "yolov5_status_level", "Diagnostics: 0 OK, 1 WARN, 2 ERROR, 3 STALE", labels=("node", "status")
        )
        numbers = GaugeMetricFamily(
            "yolov5_diagnostics", "Each number in the diagnostics", labels=("node", "status", "key")
        )
        for detector in self._detectors():
            state.add_metric((detector.name, detector.state), 1)
            for status in detector.statuses.values():
                level.add_metric((detector.name, status.name), status.level)
                for key in status.values:
                    if (number := status.number(key)) is not None:
                        numbers.add_metric((detector.name, status.name, key), number)
        return state, level, numbers


def figures(detectors: Callable[[], Iterable[Detector]]) -> Callable[[], bytes]:
    """A function that returns the current metrics of `detectors()`, as UTF-8."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_DetectorCollector(detectors))
    return lambda: bytes(generate_latest(registry))
