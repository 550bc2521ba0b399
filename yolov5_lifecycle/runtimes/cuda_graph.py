"""CUDA graph capture and replay."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

_WARM_UPS = 3  # libraries select algorithms and allocate memory, which is not allowed during capture
_PATIENCE_S = 10.0
_ONE_AT_A_TIME = threading.Lock()
_HAS_FAILED = threading.Event()


class RecordedNetwork:
    """A CUDA graph of `forward` for uint8 RGB frames (h, w, 3): one launch instead of one per kernel.

    Raises RuntimeError when `forward` fails or cannot be captured.
    """

    def __init__(
        self, forward: Callable[[Tensor], Tensor], size_hw: tuple[int, int], device: torch.device
    ) -> None:
        self._frame = torch.zeros((*size_hw, 3), dtype=torch.uint8, device=device)
        with _alone(), torch.cuda.device(device):
            self._graph = torch.cuda.CUDAGraph()
            # torch's default capture stream belongs to the first GPU that captured, and stays the current
            # stream after a failed capture.
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UPS):
                    forward(self._frame)
                # thread_local, as other threads may allocate GPU memory meanwhile, e.g. to load a model.
                recording = torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local")
                with _last_if_it_fails(), recording:
                    self._predictions = forward(self._frame)
            torch.cuda.current_stream().wait_stream(stream)

    def __call__(self, frame: Tensor) -> Tensor:
        """The output of `forward`, in memory that the next frame overwrites."""
        self._frame.copy_(frame)
        self._graph.replay()
        return self._predictions


@contextmanager
def _alone() -> Iterator[None]:
    """Allow one capture at a time per process, as torch requires, and none after a failed one."""
    if not _ONE_AT_A_TIME.acquire(timeout=_PATIENCE_S):
        raise RuntimeError(f"Another recording has not ended within {_PATIENCE_S:g} s.")
    try:
        if _HAS_FAILED.is_set():
            raise RuntimeError("An earlier recording of this process has failed.")
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
