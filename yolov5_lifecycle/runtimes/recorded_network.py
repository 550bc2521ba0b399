"""A forward pass recorded as a CUDA graph."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

_WARM_UPS = 3  # libraries select algorithms and allocate memory, which is not allowed during capture
_CAPTURE_PATIENCE_S = 10.0
_ONE_AT_A_TIME = threading.Lock()
_HAS_FAILED = threading.Event()

Forward = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
"""Frames (batch, h, w, 3) RGB or (batch, h, w, 1) grey -> all predictions (batch, N, 5 + C + M), and the
features of the finest and of the coarsest level (batch, channels, ny, nx). The next run may overwrite them.
"""


class RecordedNetwork:
    """A CUDA graph of `forward` for uint8 frames (batch, h, w, channels): one launch for all kernels.

    Raises RuntimeError when `forward` fails or cannot be captured.
    """

    def __init__(self, forward: Forward, shape: tuple[int, ...], device: torch.device) -> None:
        self._frames = torch.zeros(shape, dtype=torch.uint8, device=device)
        with _alone(), torch.cuda.device(device):
            self._graph = torch.cuda.CUDAGraph()
            # torch's default capture stream belongs to the first GPU that captured, and stays the current
            # stream after a failed capture.
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UPS):
                    forward(self._frames)
                # thread_local, as other threads may allocate GPU memory meanwhile, e.g. to load a model.
                recording = torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local")
                with _last_if_it_fails(), recording:
                    self._predictions = forward(self._frames)
            torch.cuda.current_stream().wait_stream(stream)

    def __call__(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The output of `forward`, in memory that the next run overwrites."""
        self._frames.copy_(frames)
        self._graph.replay()
        return self._predictions


@contextmanager
def _alone() -> Iterator[None]:
    """Allow one capture at a time per process, as torch requires, and none after a failed one."""
    if not _ONE_AT_A_TIME.acquire(timeout=_CAPTURE_PATIENCE_S):
        raise RuntimeError(f"Another CUDA graph capture has not ended within {_CAPTURE_PATIENCE_S:g} s.")
    try:
        if _HAS_FAILED.is_set():
            raise RuntimeError("An earlier CUDA graph capture in this process failed.")
        yield
    finally:
        _ONE_AT_A_TIME.release()


@contextmanager
def _last_if_it_fails() -> Iterator[None]:
    """Disable capture after a failure, which corrupts the allocator state (pytorch/pytorch#180395)."""
    try:
        yield
    except torch.OutOfMemoryError:  # leaves the allocator intact
        raise
    except RuntimeError:
        _HAS_FAILED.set()
        raise
