"""The cost of a network is what torch counts and allocates, and is found without building the network."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
import torch
from support.checkpoint_builder import SMALL
from support.formula_model import EVERY_FAMILY, family_architecture
from support.small_families import EVERY_SMALL, SMALL_FAMILIES
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from yolov5_lifecycle.models.architecture import SIZES, Architecture, Layer
from yolov5_lifecycle.models.cost import (
    check_architecture,
    check_memory,
    check_proportions,
    checked_cost,
    cost_of,
    size_multiple,
    strides_of,
    usual_cost,
)
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.model import blueprint
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime, prepared

PLAIN = Architecture(
    depth_multiple=1, width_multiple=1, classes=1, anchors_px=(((10, 10),),), strides=(1,), layers=()
)


def counted_flops(architecture: Architecture, size_hw: tuple[int, int]) -> int:
    """What torch itself counts for one image, with prototypes of masks."""
    network = blueprint(architecture).eval()
    pixels = torch.zeros(1, architecture.image_channels, *size_hw, device="meta")
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        features = network.features(pixels)
        network.predictions(features)
        if isinstance(network.head, Segment):
            network.head.proto(features[0])
    return int(counter.get_total_flops())


def allocated_bytes(run: Callable[[], object]) -> int:
    """The most memory that torch has allocated at once while `run` runs."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiled:
        run()
    assert profiled.profiler is not None
    events = profiled.profiler.kineto_results.events()
    kept = most = 0
    for event in events:
        if event.name() == "[memory]":
            kept += event.nbytes()
            most = max(most, kept)
    return most


def check_cost(architecture: Architecture) -> None:
    """Compare multiply-adds and memory with torch's, for an image that is not square."""
    multiple = size_multiple(architecture)
    height = -(-320 // multiple) * multiple
    cost = cost_of(architecture, (height, height + multiple))
    flops = counted_flops(architecture, cost.size_hw)
    assert 2 * cost.multiply_adds == pytest.approx(flops, rel=0.1)
    assert cost.weight_bytes == 4 * sum(weight.numel() for weight in blueprint(architecture).parameters())

    device, dtype = torch.device("cpu"), torch.float32
    runtime = TorchRuntime(prepared(Network(architecture), device, dtype), device=device, dtype=dtype)
    frame = np.zeros((*cost.size_hw, 3), np.uint8)

    def run() -> None:
        predictions = runtime(frame, "rgb")
        if predictions.compute_prototypes is not None:
            predictions.compute_prototypes()

    run()
    assert cost.activation_bytes == pytest.approx(allocated_bytes(run), rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("name", [*SIZES, *EVERY_FAMILY])
def test_the_cost_is_what_torch_counts_and_allocates(name: str) -> None:
    check_cost(SIZES[name] if name in SIZES else family_architecture(name))


@pytest.mark.long
@pytest.mark.parametrize("architecture", EVERY_SMALL.values(), ids=EVERY_SMALL)
def test_the_arithmetic_of_every_kind_of_layer_is_what_torch_counts(architecture: Architecture) -> None:
    cost = cost_of(architecture, (64, 96))
    assert 2 * cost.multiply_adds == pytest.approx(counted_flops(architecture, (64, 96)), rel=0.1)


@pytest.mark.parametrize(
    ("strides", "multiple"),
    [
        pytest.param((3, 5), 15, id="odd"),
        pytest.param((8, 8, 8, 2), 1024, id="the largest"),
    ],
)
def test_sides_of_images_are_multiples_of_what_every_layer_takes(
    strides: tuple[int, ...], multiple: int
) -> None:
    layers = [Layer((-1,), 1, "Conv", (8, stride + 1 - stride % 2, stride)) for stride in strides]
    architecture = dataclasses.replace(
        SIZES["n"],
        layers=(*layers, Layer((len(layers) - 1,), 1, "Detect")),
        strides=(multiple,),
        anchors_px=SIZES["n"].anchors_px[:1],
    )
    assert strides_of(architecture) == ((Fraction(multiple),), multiple)


@pytest.mark.parametrize("count", [4, 500], ids=["four", "none of the largest image's pixels is left"])
def test_a_stride_that_no_image_fits_is_told_as_too_large(count: int) -> None:
    layers = tuple(Layer((-1,), 1, "MaxPool2d", (8, 8, 0)) for _ in range(count))
    head = Layer((count - 1,), 1, "Detect")
    architecture = dataclasses.replace(PLAIN, layers=(*layers, head))
    assert size_multiple(architecture) > 1024


def test_the_smallest_strides_are_those_of_layers_that_enlarge() -> None:
    layers = (Layer((-1,), 1, "Upsample"),) * 150
    architecture = dataclasses.replace(PLAIN, layers=(*layers, Layer((149,), 1, "Detect")))
    assert strides_of(architecture) == ((Fraction(1, 2**150),), 1)


@pytest.mark.parametrize(
    ("size", "gflops"), [("n", 4.5), ("s", 16.5), ("m", 49.0), ("l", 109.1), ("x", 205.7)], ids=str
)
def test_the_figures_are_those_that_yolov5_publishes(size: str, gflops: float) -> None:
    cost = usual_cost(SIZES[size])
    assert 2 * cost.multiply_adds / 1e9 == pytest.approx(gflops, rel=0.02)
    assert cost.pixels == "640x640"


def test_a_layer_that_is_read_again_is_kept_and_no_other() -> None:
    def most_bytes(source: int) -> int:
        chain = tuple(Layer((-1,), 1, "Conv", (64, 3, 1)) for _ in range(20))
        joined = (Layer((-1, source), 1, "Concat"), Layer((-1,), 1, "Conv", (64, 3, 1)))
        layers = (Layer((-1,), 1, "Conv", (64, 3, 1)), *chain, *joined, Layer((22,), 1, "Detect"))
        return cost_of(dataclasses.replace(PLAIN, layers=layers), (128, 128)).activation_bytes

    layer_bytes = 4 * 64 * 128 * 128
    assert most_bytes(19) == most_bytes(0), "only one more layer is kept, whichever that is"
    assert most_bytes(0) < 7 * layer_bytes


def test_the_cost_is_one_line_for_people() -> None:
    cost = dataclasses.replace(
        usual_cost(SIZES["n"]),
        multiply_adds=2_250_000_000,
        activation_bytes=30_000_000,
        weight_bytes=5_000_000,
    )
    assert str(cost) == "4.5 GFLOPs, 35 MB at 640x640"
    assert str(dataclasses.replace(cost, activation_bytes=3_000_000_000)) == "4.5 GFLOPs, 3.0 GB at 640x640"


@pytest.mark.long
@pytest.mark.parametrize(
    "architecture",
    [
        *(pytest.param(SIZES[size], id=size) for size in SIZES),
        *(pytest.param(architecture, id=name) for name, architecture in EVERY_SMALL.items()),
        *(
            pytest.param(dataclasses.replace(SIZES[size], classes=10_000), id=f"{size}, 10,000 classes")
            for size in ("n", "x", "x6")
        ),
    ],
)
@pytest.mark.parametrize("image_size", [320, 4096])
def test_no_real_model_is_out_of_proportion(architecture: Architecture, image_size: int) -> None:
    if architecture is SMALL_FAMILIES["transformer"]:
        image_size = 64  # attention of every fourth pixel to each other
    check_architecture(architecture)
    check_proportions(cost_of(architecture, (image_size, image_size)))


def test_what_would_take_minutes_is_refused() -> None:
    wide = Layer((-1,), 1, "Conv", (128, 15, 1))
    slow = dataclasses.replace(PLAIN, layers=(wide, wide, Layer((1,), 1, "Detect")))
    with pytest.raises(ValueError, match=r"the network would compute 124 GFLOPs .* at most 82"):
        check_architecture(slow)


def test_attention_is_refused_for_images_for_which_it_needs_too_much() -> None:
    architecture = SMALL_FAMILIES["transformer"]
    check_architecture(architecture)
    checked_cost(architecture, 128)
    with pytest.raises(ValueError, match=r"^Image size 640: layer 2 \(C3TR\) would keep 21\.0 GB") as refusal:
        checked_cost(architecture, 640)
    assert str(refusal.value).endswith("Use a smaller image_size or model.")


def test_what_exceeds_the_free_memory_is_refused_with_both_figures() -> None:
    cost = cost_of(SIZES["x6"], (4096, 4096))
    check_memory(cost, cost.memory_bytes, free_bytes=cost.memory_bytes)
    with pytest.raises(ValueError, match=r"Image size 4096: the model needs 2\.8 GB .* 500 MB are available"):
        check_memory(cost, cost.memory_bytes, free_bytes=500_000_000)


@pytest.mark.parametrize("kind", ["C3TR", "Contract"])
def test_a_layer_that_has_no_pixels_left_costs_what_is_before_it(kind: str) -> None:
    small = SMALL
    pools = [Layer((-1,), 1, "MaxPool2d", args) for args in ((15, 8, 0), *[(2, 1, 0)] * 3)]
    layers = (*small.layers[:-1], *pools, Layer((-1,), 1, kind, (2,)), small.layers[-1])
    emptied = dataclasses.replace(small, layers=layers)
    assert cost_of(emptied, (128, 128)).multiply_adds >= cost_of(small, (128, 128)).multiply_adds
