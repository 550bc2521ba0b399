"""Benchmark of the project against its alternatives."""

from yolov5_lifecycle.process.environment import disable_telemetry

disable_telemetry()  # the other variables of the commands would affect the rivals' processes
