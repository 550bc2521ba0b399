"""OpenVINO engine."""

from __future__ import annotations

from functools import cache, partial

from yolov5_lifecycle.process.environment import disable_telemetry

disable_telemetry()  # before the import below; a program that uses this package may not have done it

import openvino

from yolov5_lifecycle.runtimes.compiled_runtime import Engine, Loaded, Run, Threads

_HINTS = {"fp32": "f32", "int8": "f32", "bf16": "bf16"}
"""Type that OpenVINO computes non-integer nodes in; by default it would use bfloat16 where supported."""


def openvino_engine(precision: str = "fp32") -> Engine:
    """OpenVINO on the CPU; `precision` fp32, int8 or bf16.

    It reads ONNX directly: the converter for torch modules would send usage statistics.
    """
    return Engine("openvino", partial(_compile, hint=_HINTS[precision]), (RuntimeError,), precision)


@cache
def _core() -> openvino.Core:
    """The only one of the process, to its end.

    Each changes the stack on which the thread handles signals, and puts back the one before when it is freed.
    Of several, freed in another order, a freed stack stays, and the next signal is a segmentation fault:
    https://github.com/openvinotoolkit/openvino/pull/11894
    """
    return openvino.Core()


def _compile(graph: bytes, threads: Threads, *, hint: str) -> Loaded:
    compiled = _core().compile_model(
        _core().read_model(graph),
        "CPU",
        {
            "PERFORMANCE_HINT": "LATENCY",
            "NUM_STREAMS": threads.at_once,
            "INFERENCE_NUM_THREADS": threads.each * threads.at_once,
            "INFERENCE_PRECISION_HINT": hint,
            "CPU_DENORMALS_OPTIMIZATION": True,  # with denormal floats a frame takes 5 times as long
            "ENABLE_CPU_PINNING": False,  # a pinned thread would wait for other processes on its core
        },
    )

    def new_run() -> Run:
        request = compiled.create_infer_request()
        return lambda values: list(request.infer([values], share_inputs=True, share_outputs=True).values())

    return new_run
