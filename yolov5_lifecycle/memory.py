"""Giving freed memory back to the operating system."""

from __future__ import annotations

import torch

from yolov5_lifecycle.heap import trim_heap


def give_back_memory() -> None:
    """Empty the caches that keep the memory of freed tensors: CUDA's allocator and the heap.

    The CUDA context itself (a few hundred MB) stays until the process ends.
    """
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    trim_heap()
