"""The network has the official shape, and computes what YOLOv5's formulas say."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
import torch
from support.random_model import random_network
from torch import nn

from yolov5_lifecycle.models.architecture import SIZES
from yolov5_lifecycle.models.blocks import SPP, SPPF, C3x, CrossConv
from yolov5_lifecycle.models.convolutions import Focus
from yolov5_lifecycle.models.network import Network, fuse

# Parameters and digest of the table of names, shapes, anchors and strides of the official checkpoints.
OFFICIAL = {
    "n": (1_872_157, "da9552858b2c65e832bef4b381227e987601917762ce335380bdfa3c2b3ad82f"),
    "n6": (3_246_940, "aa5af38ba6381b466b347c694a8cdb481aef2c4dc2cfe4271e59f07d799733da"),
    "s": (7_235_389, "ee65ac48780db27409ed908c2358b51216ee93e9d75772a4c97cb37993e92456"),
    "s6": (12_626_620, "4ee4b64c7f87a41a6c82c5a6cd84d431a29c479cb8a9be365a8d4051dfc03b1e"),
    "m": (21_190_557, "8cada75bfc01229ac4abea5136a0d270374c22ab619153fe9d86c9ead3223f62"),
    "m6": (35_731_932, "b411efb58514077c739392f41042c8b37176ae85ba7506423c47e744a45b191e"),
    "l": (46_563_709, "b5cdf4977f189936bfd3ec145b8656ea3a862ce06c041251a2f5ba3a4dbb7a07"),
    "l6": (76_770_172, "a8a06eafc95d0cce645fd416af869d703b795c55de5d7c9461308f088693bd70"),
    "x": (86_749_405, "81d126c3328a706a7f1cf886c6ff4669544ad8ebaea86796fbede40986104a5d"),
    "x6": (140_794_780, "2496c1f525dc8f2bda39a2709e57a07cc09a8ebda4b548c00a60e115baad4d2a"),
}


def digest(network: Network) -> str:
    architecture = network.architecture
    table = {
        "anchors_px": [[list(map(float, anchor)) for anchor in level] for level in architecture.anchors_px],
        "state_dict": {key: list(tensor.shape) for key, tensor in network.state_dict().items()},
        "strides": architecture.strides,
    }
    return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()


@pytest.mark.parametrize("size", SIZES)
def test_names_and_shapes_are_those_of_the_official_checkpoint(size: str) -> None:
    with torch.device("meta"):
        network = Network(SIZES[size])
    parameters = sum(parameter.numel() for parameter in network.parameters())
    assert (parameters, digest(network)) == OFFICIAL[size]


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_a_focus_has_its_stride_after_taking_every_second_pixel(stride: int) -> None:
    focus = Focus(3, 8, 3, stride)
    assert focus(torch.zeros(1, 3, 64, 96)).shape == (1, 8, 32 // stride, 48 // stride)


def test_pooling_with_small_windows_one_after_the_other_is_pooling_with_every_window() -> None:
    spp = SPP(8, 4, (3, 5, 9, 13)).eval()
    pixels = torch.rand(1, 8, 20, 30, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        narrow = spp.cv1(pixels)
        expected = spp.cv2(torch.cat([narrow, *(pool(narrow) for pool in spp.m.children())], dim=1))
        assert torch.equal(spp(pixels), expected)
    assert SPPF(8, 4, 3).steps == (3, 3, 3), "the same small window each time"


@pytest.mark.parametrize("shortcut", [True, False])
def test_crossed_convolutions_add_their_input_if_they_are_told_to(shortcut: bool) -> None:
    parts = [part for part in C3x(8, 8, 2, shortcut).modules() if isinstance(part, CrossConv)]
    assert [part.add for part in parts] == [shortcut] * 2


def test_predictions_of_half_layers_are_decoded_in_full_precision() -> None:
    network = fuse(random_network(0))
    pixels = torch.rand(1, 3, 64, 640)
    with torch.inference_mode():
        expected = network(pixels)
        for module in network.modules():
            if isinstance(module, nn.Conv2d):
                module.to(torch.float16)
        raw = network(pixels.half())
    assert raw.dtype == torch.float32
    np.testing.assert_allclose(raw, expected, rtol=0.02, atol=0.1, equal_nan=False)
    centres = raw[..., :2]
    assert (centres != centres.half()).any()
