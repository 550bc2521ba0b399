"""Giving freed memory back to the operating system."""

from __future__ import annotations

import ctypes
import sys

import torch


def give_back_memory() -> None:
    """Empty the caches that keep the memory of freed tensors: CUDA's allocator and glibc's heap.

    The CUDA context itself (a few hundred MB) stays until the process ends.
    """
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # absent in musl
        if trim is not None:
            trim(0)
