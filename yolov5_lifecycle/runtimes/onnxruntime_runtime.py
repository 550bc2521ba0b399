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
    # Waiting threads that spin gain 4 ms of 24 alone, but with one busy neighbour they double the time.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    return lambda planes: session.run(["raw"], {"planes": planes})[0]
