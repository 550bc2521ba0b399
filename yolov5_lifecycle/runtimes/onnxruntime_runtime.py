"""ONNX Runtime engine."""

from __future__ import annotations

import logging

from yolov5_lifecycle.process.environment import disable_telemetry

disable_telemetry()  # before the import below; a program that uses this package may not have done it

import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as state

from yolov5_lifecycle.atomic_file import remove_abandoned_folders, temporary_folder
from yolov5_lifecycle.runtimes.compiled_runtime import Engine, Loaded, Threads

_log = logging.getLogger(__name__)

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
    """ONNX Runtime on the CPU. Runs of one session at the same time share its threads but for the callers'.

    Removes the temporary folders of processes that were killed while they compiled.
    """
    remove_abandoned_folders()
    return Engine("onnxruntime", _build, _session, _ERRORS)


def _build(graph: bytes, threads: Threads) -> tuple[Loaded, bytes]:
    """Compile `graph`; the bytes to cache are the optimized graph, fused and laid out for this CPU.

    ONNX Runtime exports it only as a file; where none can be written, nothing is cached.
    """
    try:
        with temporary_folder() as folder:
            file = folder / "optimized.onnx"
            return _session(graph, threads, str(file)), file.read_bytes()
    except (OSError, *_ERRORS) as error:
        loaded = _session(graph, threads)  # raises if the graph is the cause
        _log.warning("The compiled model is not cached, because no temporary file can be written: %s", error)
        return loaded, b""


def _session(graph: bytes, threads: Threads, optimized_file: str = "") -> Loaded:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.optimized_model_filepath = optimized_file
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
    return Loaded(lambda: lambda values: session.run(None, {name: values}))


def _waiting() -> tuple[str, str]:
    """Session config entry for how long idle threads spin.

    Spinning for 20 us saves 1.5 of 18 ms alone and costs 1 of 31 ms next to a busy process; 200 us cost
    12 ms, the default (milliseconds) 20 ms. Before 1.26 there is no duration (microsoft/onnxruntime#27916).
    """
    release = tuple(int(part) for part in onnxruntime.__version__.split(".")[:2])
    if release >= (1, 26):
        return "session.intra_op.spin_duration_us", "20"
    return "session.intra_op.allow_spinning", "0"
