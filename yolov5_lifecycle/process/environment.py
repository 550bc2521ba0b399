"""Process setup that libraries need before their import: environment variables and enough threads."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress

WAITING: Mapping[str, str] = {
    # By default the threads of OpenMP, which torch uses, spin at every barrier: next to other busy processes,
    # as on a robot, yolov5n at 384x640 then took 1.3 to 4.9 s on two cores instead of 0.05 to 0.1 s.
    "OMP_WAIT_POLICY": "PASSIVE",
    # By default the threads of numpy's OpenBLAS spin for milliseconds after each matrix product, which delays
    # the network: one image then took 22 to 30 ms instead of 16.
    "OPENBLAS_NUM_THREADS": "1",
}
"""Thread waiting policies."""

MAX_COMPRESSED_PX = 1 << 26
"""Pixels of a compressed image. A file of 200 bytes may claim any size; see docs/images.md for its memory."""


def prepare_environment() -> None:
    """Set unset variables; call before numpy, OpenCV, torch and onnxruntime are imported.

    OpenCV then rejects images of any format with more than MAX_COMPRESSED_PX pixels before decoding; its
    default limit is 2**30.
    """
    for name, value in {**WAITING, "OPENCV_IO_MAX_IMAGE_PIXELS": str(MAX_COMPRESSED_PX)}.items():
        os.environ.setdefault(name, value)
    disable_telemetry()


def disable_telemetry() -> None:
    """Disable telemetry of ONNX Runtime unless the variable is set, and block openvino_telemetry.

    By default ONNX Runtime, from release 1.31 on, looks up a telemetry host of its vendor, and writes a
    device id and an event database to the cache folder and a session file to the temporary folder.

    `import openvino` would send an event to a host of its vendor and write an id to the home folder, without
    a variable that prevents it. Where openvino_telemetry cannot be imported, it does neither; see
    https://github.com/openvinotoolkit/openvino/blob/master/tools/ovc/openvino/tools/ovc/telemetry_utils.py
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]  # None blocks an import


def thread_problem(count: int) -> str:
    """Why `count` additional threads cannot run at the same time; "" if they can.

    Beyond the limit, C++ libraries abort the process.
    """
    release, threads = threading.Event(), list[threading.Thread]()
    with suppress(RuntimeError):  # the thread limit is reached
        for _ in range(count):
            thread = threading.Thread(target=release.wait, daemon=True)
            thread.start()
            threads.append(thread)
    release.set()
    for thread in threads:
        thread.join()
    if len(threads) == count:
        return ""
    return (
        f"{count} threads are needed, {len(threads)} can be started: raise the limit of processes "
        "(`ulimit -u`, TasksMax= of systemd, --pids-limit of Docker), or end other processes of this user."
    )


def compute_threads() -> int:
    """Number of threads that the numerical libraries start for each of their pools."""
    return len(os.sched_getaffinity(0))
