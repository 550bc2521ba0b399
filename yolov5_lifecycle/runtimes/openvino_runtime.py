"""The network run by OpenVINO."""

from __future__ import annotations

import openvino
import torch

from yolov5_lifecycle.runtimes.engine import Engine, Run


def openvino_engine() -> Engine:
    """OpenVINO on the CPU, with as many threads as torch would use.

    It reads the graph itself: its converter for torch modules would send usage statistics. The graph is kept
    as it is: what OpenVINO would keep is larger, and of large networks no faster to read than to make.
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
            "INFERENCE_PRECISION_HINT": "f32",  # else bfloat16 where the CPU has it
            "ENABLE_CPU_PINNING": False,  # a thread bound to a core would wait for a neighbour there
        },
    )
    request = compiled.create_infer_request()
    return lambda planes: list(request.infer([planes], share_inputs=True, share_outputs=True).values())
