"""Trains the embedded model: `python -m tools.shapes.train --out weights/shapes.safetensors`."""

from __future__ import annotations

import argparse
import logging
import math
import time
from pathlib import Path

import cv2
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.data import DataLoader

from tools.shapes.images import Batch, Batches
from tools.shapes.loss import detection_loss
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.model import Model, checked_model
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.sources.scene import CLASS_NAMES

SEED = 20_250_101
STEPS = 4_500
ARCHITECTURE = Architecture(
    depth_multiple=0.33,
    width_multiple=0.125,
    classes=len(CLASS_NAMES),
    # The boxes of regular shapes are nearly square, so only the size of an anchor matters.
    anchors_px=(
        ((18, 18), (25, 25), (36, 36)),
        ((50, 50), (70, 70), (100, 100)),
        ((140, 140), (200, 200), (280, 280)),
    ),
    strides=(8, 16, 32),
)
OBJECTNESS_SHIFT = 1.4
"""Logits subtracted from every objectness after the training, so that precision and recall are similar at the
default threshold: chosen among 0.6, 1.0 and 1.4 on 150 images of seed 7."""
_PEAK_LEARNING_RATE = 3e-3
_log = logging.getLogger("train")


def train(*, seed: int, steps: int) -> Network:
    """Train a network on `steps` batches; returned in evaluation mode, reproducible on one machine."""
    torch.manual_seed(seed)
    # The operations are too small to parallelize: beside other processes two threads mostly wait.
    torch.set_num_threads(1)
    network = _fresh_network()
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(0.998), use_buffers=True)
    optimizer = _optimizer(network)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, _PEAK_LEARNING_RATE, total_steps=steps, pct_start=0.05, final_div_factor=100
    )
    started = time.monotonic()
    recent = 0.0
    for step, batch in enumerate(_batches(seed, steps), start=1):
        loss = _loss(network, batch)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        average.update_parameters(network)
        recent = loss.item() if step == 1 else 0.98 * recent + 0.02 * loss.item()
        if step % 50 == 0:
            _log.info("step %d of %d, loss %.4f, %.0f s", step, steps, recent, time.monotonic() - started)
    averaged = average.module
    assert isinstance(averaged, Network)
    lower_objectness(averaged, OBJECTNESS_SHIFT)
    return averaged.eval()


def lower_objectness(network: Network, shift: float) -> None:
    """Subtract `shift` from the objectness logits, in place."""
    for bias in _head_biases(network):
        bias[:, 4] -= shift


def _head_biases(network: Network) -> list[Tensor]:
    """Views of the biases (anchors, 5 + C) of each level."""
    detect = network.head
    biases = [convolution.bias for convolution in detect.m if isinstance(convolution, nn.Conv2d)]
    return [bias.detach().view(detect.anchors_per_cell, -1) for bias in biases if bias is not None]


def _fresh_network() -> Network:
    """A network with random weights; scores start at the average of an image with a few shapes."""
    network = Network(ARCHITECTURE)
    for bias, stride in zip(_head_biases(network), ARCHITECTURE.strides, strict=True):
        bias[:, 4] = math.log(8 / (640 / stride) ** 2)
        bias[:, 5:] = math.log(1 / (len(CLASS_NAMES) - 1))
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing from its overloads
    return network


def _optimizer(network: Network) -> torch.optim.Optimizer:
    """AdamW with weight decay on the convolutions only."""
    kernels = [parameter for parameter in network.parameters() if parameter.ndim > 1]
    others = [parameter for parameter in network.parameters() if parameter.ndim == 1]
    groups = [{"params": kernels, "weight_decay": 0.02}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=_PEAK_LEARNING_RATE)


def _batches(seed: int, steps: int) -> DataLoader[Batch]:
    """Batches generated in another process, in order."""
    return DataLoader(
        Batches(seed, steps),
        batch_size=None,
        num_workers=1,
        prefetch_factor=8,
        worker_init_fn=lambda _: cv2.setNumThreads(1),
    )


def _loss(network: Network, batch: Batch) -> Tensor:
    pixels = batch.pixels.to(memory_format=torch.channels_last).float() / 255
    return detection_loss(network.heads(pixels), batch.targets, network.architecture)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="the .safetensors file to write")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--steps", type=int, default=STEPS)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    network = train(seed=arguments.seed, steps=arguments.steps)
    write_safetensors(model_of(network), arguments.out)


def model_of(network: Network) -> Model:
    """The model of `network` and the class names, with weights rounded to fp16."""
    tensors = {
        key: tensor.half().float() if tensor.is_floating_point() else tensor
        for key, tensor in network.state_dict().items()
    }
    return checked_model(network.architecture, CLASS_NAMES, tensors)


if __name__ == "__main__":
    main()
