"""The network run by ONNX Runtime."""

from __future__ import annotations

import onnxruntime
import torch
from onnxruntime.capi import onnxruntime_pybind11_state as state

from yolov5_lifecycle.runtimes.compiled_runtime import Engine, Run


def onnxruntime_engine() -> Engine:
    """ONNX Runtime on the CPU, with as many threads as torch would use."""
    errors = (RuntimeError, state.Fail, state.InvalidArgument, state.RuntimeException, state.EPFail)
    return Engine("onnxruntime", _compile, errors)


def _compile(graph: bytes) -> Run:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    # A number of our own also keeps threads from being bound to cores, where they wait for a neighbour.
    options.intra_op_num_threads = torch.get_num_threads()
    options.add_session_config_entry(*_waiting())
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    return lambda planes: session.run(None, {"planes": planes})


def _waiting() -> tuple[str, str]:
    """How a thread waits for the others, as an entry of the session's configuration.

    Of 18 ms alone 20 us of spinning gain 1.5 ms and lose 1 of 31 beside a busy process; 200 us lose 12, the
    default of milliseconds 20. Releases before 1.26 take no duration (microsoft/onnxruntime#27916).
    """
    release = tuple(int(part) for part in onnxruntime.__version__.split(".")[:2])
    if release >= (1, 26):
        return "session.intra_op.spin_duration_us", "20"
    return "session.intra_op.allow_spinning", "0"
