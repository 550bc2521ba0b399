"""The network run by ONNX Runtime."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

import onnxruntime
import torch
from onnxruntime.capi import onnxruntime_pybind11_state as state

from yolov5_lifecycle.runtimes.engine import Engine, Run

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
    """ONNX Runtime on the CPU, with as many threads as torch would use."""
    return Engine("onnxruntime", _build, _session, _ERRORS)


def _build(graph: bytes) -> tuple[Run, bytes]:
    """Kept is the graph with its nodes joined and its weights laid out for this processor.

    ONNX Runtime hands that out as a file only; where none can be written, nothing is kept.
    """
    try:
        with tempfile.TemporaryDirectory(prefix="yolov5_lifecycle-") as folder:
            file = Path(folder) / "optimized.onnx"
            return _session(graph, str(file)), file.read_bytes()
    except (OSError, *_ERRORS) as error:
        run = _session(graph)  # raises if the graph is to blame
        _log.warning("The compiled model is not kept, as no temporary file could be written: %s", error)
        return run, b""


def _session(graph: bytes, optimized_file: str = "") -> Run:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.optimized_model_filepath = optimized_file
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
