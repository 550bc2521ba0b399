"""A network's run on a GPU, recorded once and then started as a whole."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

_WARM_UPS = 3  # libraries choose their algorithms and take their memory, which a recording must not
_PATIENCE_S = 10.0
_ONE_AT_A_TIME = threading.Lock()
_HAS_FAILED = threading.Event()


class RecordedNetwork:
    """A CUDA graph of `forward` for RGB frames (h, w, 3) of uint8: one start instead of one for each layer.

    Raises RuntimeError when `forward` fails or does what cannot be recorded.
    """

    def __init__(
        self, forward: Callable[[Tensor], Tensor], size_hw: tuple[int, int], device: torch.device
    ) -> None:
        self._frame = torch.zeros((*size_hw, 3), dtype=torch.uint8, device=device)
        with _alone(), torch.cuda.device(device):
            self._graph = torch.cuda.CUDAGraph()
            # torch's own stream for recordings belongs to the first GPU that was recorded on, and stays the
            # current one after a recording that has failed.
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UPS):
                    forward(self._frame)
                # thread_local, as others may take memory of the GPU meanwhile: where a model is loaded, say.
                recording = torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local")
                with _last_if_it_fails(), recording:
                    self._predictions = forward(self._frame)
            torch.cuda.current_stream().wait_stream(stream)

    def __call__(self, frame: Tensor) -> Tensor:
        """What `forward` gives, in memory that the next frame overwrites."""
        self._frame.copy_(frame)
        self._graph.replay()
        return self._predictions


@contextmanager
def _alone() -> Iterator[None]:
    """One recording at a time, as torch demands of a process, and none after one that has failed."""
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
    """The next recording would stumble over what this leaves in the allocator (pytorch/pytorch#180395)."""
    try:
        yield
    except torch.OutOfMemoryError:  # leaves nothing behind
        raise
    except RuntimeError:
        _HAS_FAILED.set()
        raise
