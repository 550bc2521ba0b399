"""ONNX Runtime engine."""

from __future__ import annotations

from yolov5_lifecycle.process.environment import disable_telemetry

disable_telemetry()  # before the import below; a program that uses this package may not have done it

import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as state

from yolov5_lifecycle.runtimes.compiled_runtime import Engine, Loaded, Threads

_ERRORS = (
    RuntimeError,
    state.Fail,
    state.InvalidArgument,
    state.InvalidProtobuf,
    state.InvalidGraph,
    state.RuntimeException,
    state.EPFail,
    state.NotImplemented,
)


def onnxruntime_engine() -> Engine:
    """ONNX Runtime on the CPU. Runs of one session share its threads, but for those of the callers."""
    return Engine("onnxruntime", _compile, _ERRORS)


def _compile(graph: bytes, threads: Threads) -> Loaded:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    # An explicit thread count also disables pinning to cores, where threads wait for other processes.
    options.intra_op_num_threads = 1 + (threads.each - 1) * threads.at_once
    options.add_session_config_entry(*_waiting())
    # Weights of 1e-36 produce denormal floats, with which a frame took 19 times as long.
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    # One block for all features of a run, planned from the first one, would stay beside those of that run.
    options.enable_mem_pattern = False
    # Fused into a max-pool, zeros at the edge would become -inf (microsoft/onnxruntime#18136).
    disabled = ["Pad_Fusion"]
    session = onnxruntime.InferenceSession(
        graph, options, providers=["CPUExecutionProvider"], disabled_optimizers=disabled
    )
    (name,) = (each.name for each in session.get_inputs())
    return lambda: lambda values: session.run(None, {name: values})


def _waiting() -> tuple[str, str]:
    """Session config entry for how long idle threads spin.

    Spinning for 20 us saves 1.5 of 18 ms alone and costs 1 of 31 ms next to a busy process; 200 us cost
    12 ms, the default (milliseconds) 20 ms. Before 1.26 there is no duration (microsoft/onnxruntime#27916).
    """
    release = tuple(int(part) for part in onnxruntime.__version__.split(".")[:2])
    if release >= (1, 26):
        return "session.intra_op.spin_duration_us", "20"
    return "session.intra_op.allow_spinning", "0"
