"""A network's run on a GPU, recorded once and then started as a whole."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_WARM_UPS = 3  # libraries choose their algorithms and take their memory, which a recording must not


class RecordedNetwork:
    """A CUDA graph of `forward` for RGB frames (h, w, 3) of uint8: one start instead of one for each layer.

    Raises RuntimeError when `forward` fails or does what cannot be recorded.
    """

    def __init__(
        self, forward: Callable[[Tensor], Tensor], size_hw: tuple[int, int], device: torch.device
    ) -> None:
        self._frame = torch.zeros((*size_hw, 3), dtype=torch.uint8, device=device)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.device(device):
            _warm_up(lambda: forward(self._frame))
            # Other threads may take and free memory of the GPU meanwhile: a model that is loaded, say.
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._predictions = forward(self._frame)

    def __call__(self, frame: Tensor) -> Tensor:
        """What `forward` gives, in memory that the next frame overwrites."""
        self._frame.copy_(frame)
        self._graph.replay()
        return self._predictions


def _warm_up(run: Callable[[], object]) -> None:
    """On a stream of its own, as torch asks of what is recorded afterwards."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(_WARM_UPS):
            run()
    torch.cuda.current_stream().wait_stream(stream)
