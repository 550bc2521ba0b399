"""OpenVINO engine."""

from __future__ import annotations

import openvino
import torch

from yolov5_lifecycle.runtimes.compiled_runtime import Engine, Run


def openvino_engine() -> Engine:
    """OpenVINO on the CPU, with as many threads as torch would use.

    It reads ONNX directly: the converter for torch modules would send usage statistics. The ONNX graph itself
    is cached: OpenVINO's own export is larger, and for large networks loading it is no faster than compiling.
    """
    return Engine("openvino", lambda graph: (_compile(graph), graph), _compile, (RuntimeError,))


def _compile(graph: bytes) -> Run:
    core = openvino.Core()
    compiled = core.compile_model(
        core.read_model(graph),
        "CPU",
        {
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_NUM_THREADS": torch.get_num_threads(),
            "INFERENCE_PRECISION_HINT": "f32",  # else bfloat16 where the CPU supports it
            "CPU_DENORMALS_OPTIMIZATION": True,  # with denormal floats a frame takes 5 times as long
            "ENABLE_CPU_PINNING": False,  # a pinned thread would wait for other processes on its core
        },
    )
    request = compiled.create_infer_request()
    return lambda values: list(request.infer([values], share_inputs=True, share_outputs=True).values())
