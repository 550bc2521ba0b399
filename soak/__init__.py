"""Soak tests of the detector process: hostile input, faults, signals and lifecycle cycles. `make soak`."""

from yolov5_lifecycle.process.environment import prepare_environment

prepare_environment()  # as in the commands; child processes inherit it
