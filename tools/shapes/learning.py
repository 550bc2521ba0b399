"""Training loop: batches, optimizer, learning rate and weight averaging."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

import cv2
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.data import DataLoader

from tools.shapes.images import Batch, Batches

Learning = TypeVar("Learning", bound=nn.Module)

_log = logging.getLogger("train")


def learned(
    module: Learning,
    loss_of: Callable[[Learning, Batch], Tensor],
    *,
    seed: int,
    steps: int,
    peak_learning_rate: float,
) -> Learning:
    """The average of `module` while it learns from `steps` batches to lower `loss_of`, a scalar.

    `module` itself changes, too. Reproducible on one machine.
    """
    # The operations are too small to parallelize: next to other processes, two threads mostly wait.
    torch.set_num_threads(1)
    average = AveragedModel(module, multi_avg_fn=get_ema_multi_avg_fn(0.998), use_buffers=True)
    optimizer = _optimizer(module, peak_learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, peak_learning_rate, total_steps=steps, pct_start=0.05, final_div_factor=100
    )
    started = time.monotonic()
    recent = 0.0
    for step, batch in enumerate(_batches(seed, steps), start=1):
        loss = loss_of(module, batch)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(module.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        average.update_parameters(module)
        recent = loss.item() if step == 1 else 0.98 * recent + 0.02 * loss.item()
        if step % 50 == 0:
            _log.info("step %d of %d, loss %.4f, %.0f s", step, steps, recent, time.monotonic() - started)
    averaged = average.module
    assert isinstance(averaged, type(module))
    return averaged


def as_input(pixels: Tensor) -> Tensor:
    """Network input for uint8 pixels (B, 3, H, W)."""
    return pixels.to(memory_format=torch.channels_last).float() / 255


def _optimizer(module: nn.Module, learning_rate: float) -> torch.optim.Optimizer:
    """AdamW with weight decay on the convolutions only."""
    kernels = [parameter for parameter in module.parameters() if parameter.ndim > 1]
    others = [parameter for parameter in module.parameters() if parameter.ndim == 1]
    groups = [{"params": kernels, "weight_decay": 0.02}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=learning_rate)


def _batches(seed: int, steps: int) -> DataLoader[Batch]:
    """Batches generated in another process, in order."""
    return DataLoader(
        Batches(seed, steps),
        batch_size=None,
        num_workers=1,
        prefetch_factor=8,
        worker_init_fn=lambda _: cv2.setNumThreads(1),
    )
