"""What a network computes and keeps in memory for an input of a given size, before it is built."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any, cast

from torch import Tensor

from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.head import Proto, Segment
from yolov5_lifecycle.models.model import blueprint
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.models.shape_tensor import CostCounter, Shape, ShapeTensor
from yolov5_lifecycle.process.memory import available_bytes

MAX_CHANNELS = 65_536
"""Max output channels of a layer; the largest of YOLOv5x6 has 1920."""
MAX_ELEMENTS_PER_PIXEL = 256
"""Max elements of a layer's output for each pixel of the network's input; the largest of YOLOv5x6 has 20."""
MAX_BYTES_PER_PIXEL = 10 << 10
"""Max activations kept at once; YOLOv5x6 has 155 bytes, three anchors of 10,000 classes at stride 8 7,400."""
MAX_MULTIPLY_ADDS_PER_PIXEL = 2_500_000
"""Ten times those of YOLOv5x6."""
_SMALL_IMAGE_SIZE, _USUAL_IMAGE_SIZE = 128, 640
_FLOAT_BYTES = 4
MAX_STRIDE = 1024
_ANY_STRIDE = math.lcm(*range(1, MAX_STRIDE + 1))
_FINEST = 10**100
"""Far more cells for each pixel than any network has, and far less than `_ANY_STRIDE`."""


@dataclass(frozen=True)
class Cost:
    """Cost of one run of a network, in float32, for `images` of `size_hw` pixels.

    `multiply_adds` are those of convolutions, linear layers and attention, as the network was trained:
    runtimes save some by merging layers. `activation_bytes` are the features and predictions that exist at
    the same time at most, which is while `layer` is computed; with masks and until NMS has selected.
    """

    images: int
    size_hw: tuple[int, int]
    multiply_adds: int
    activation_bytes: int
    layer: str
    weight_bytes: int
    outputs: tuple[tuple[str, Shape], ...]
    """Each layer before the head, such as "layer 3 (Conv)", and its output, (images, channels, ny, nx)."""

    @property
    def memory_bytes(self) -> int:
        """Activations and weights."""
        return self.activation_bytes + self.weight_bytes

    @property
    def pixels(self) -> str:
        """Width and height, such as "640x384"."""
        height, width = self.size_hw
        return f"{width}x{height}"

    @property
    def subject(self) -> str:
        """Such as "an image of 640x384"."""
        return f"{self.images} images of {self.pixels}" if self.images > 1 else f"an image of {self.pixels}"

    def __str__(self) -> str:
        """Such as "4.5 GFLOPs, 41 MB at 640x640"."""
        return f"{2 * self.multiply_adds / 1e9:,.1f} GFLOPs, {megabytes(self.memory_bytes)} at {self.pixels}"


def cost_of(architecture: Architecture, size_hw: tuple[int, int], *, images: int = 1) -> Cost:
    """The cost for `images` of `size_hw`, height and width multiples of `size_multiple`.

    Found by running the network on tensors without numbers, so it takes no memory, whatever the figures.
    Raises WeightsError if no network can be built, ValueError if its layers do not fit each other.
    """
    network = blueprint(architecture).eval()
    counter = CostCounter()
    outputs = _watched(network, counter)
    _run(network, ShapeTensor((images, architecture.image_channels, *size_hw), counter))
    return Cost(
        images=images,
        size_hw=size_hw,
        multiply_adds=counter.multiply_adds,
        activation_bytes=_FLOAT_BYTES * counter.most_elements,
        layer=counter.layer_of_most,
        weight_bytes=_FLOAT_BYTES * sum(parameter.numel() for parameter in network.parameters()),
        outputs=tuple(outputs),
    )


@lru_cache(maxsize=16)
def strides_of(architecture: Architecture) -> tuple[tuple[Fraction, ...], int]:
    """The strides of what the head reads, and the number of which input height and width must be multiples.

    That is the largest stride; that of a layer may be larger than those of the detection levels. A number
    above `MAX_STRIDE` is only known to be too large. Found by running the network for an image whose sides
    are multiples of each smaller stride. Raises like `cost_of`.
    """
    network = blueprint(architecture).eval()
    counter = CostCounter()
    outputs = _watched(network, counter)
    pixels = ShapeTensor((1, architecture.image_channels, _ANY_STRIDE, _ANY_STRIDE), counter)
    levels = network.features(cast(Tensor, pixels))
    multiple = math.lcm(*(max(nearest_stride(_stride(shape)).numerator, 1) for _, shape in outputs))
    return tuple(_stride(level.shape) for level in levels), multiple


def _stride(shape: Shape) -> Fraction:
    return Fraction(_ANY_STRIDE, max(shape[2], 1))  # strides of 8 after each other may leave no cell


def nearest_stride(stride: Fraction) -> Fraction:
    """A stride of `strides_of` without the cells that layers add or take at the edge."""
    return stride.limit_denominator(_FINEST)


def size_multiple(architecture: Architecture) -> int:
    """The number of which input height and width must be multiples for all layers to fit each other."""
    return strides_of(architecture)[1]


def usual_cost(architecture: Architecture) -> Cost:
    """The cost for an image of 640x640, or of the next larger size that fits; raises like `cost_of`."""
    return cost_of(architecture, _square(architecture, _USUAL_IMAGE_SIZE))


def check_architecture(architecture: Architecture) -> None:
    """Raise ValueError if a small image already costs more than `check_proportions` allows.

    The attention of every cell to every cell grows with the square of the image: for a larger one it is
    checked when the image size is known.
    """
    check_proportions(cost_of(architecture, _square(architecture, _SMALL_IMAGE_SIZE)))


def check_proportions(cost: Cost) -> None:
    """Raise ValueError if a layer, or all of them, cost more for each pixel than any model needs.

    A small weights file can ask for any amount of memory: most layers that enlarge features have no weights.
    """
    pixels = cost.images * math.prod(cost.size_hw)
    for layer, shape in cost.outputs:
        if shape[1] > MAX_CHANNELS:
            raise ValueError(f"{layer} would have {shape[1]:,} channels, at most {MAX_CHANNELS:,}")
        if math.prod(shape) > MAX_ELEMENTS_PER_PIXEL * pixels:
            raise ValueError(
                f"{layer} would have {math.prod(shape):,} elements for {cost.subject}, at most "
                f"{MAX_ELEMENTS_PER_PIXEL * pixels:,}"
            )
    max_bytes = MAX_BYTES_PER_PIXEL * pixels + cost.weight_bytes  # of which one layer's are copied
    if cost.activation_bytes > max_bytes:
        raise ValueError(
            f"{cost.layer} would keep {megabytes(cost.activation_bytes)} of features and predictions for "
            f"{cost.subject}, at most {megabytes(max_bytes)}"
        )
    if cost.multiply_adds > MAX_MULTIPLY_ADDS_PER_PIXEL * pixels:
        raise ValueError(
            f"the network would compute {2 * cost.multiply_adds / 1e9:,.0f} GFLOPs for {cost.subject}, "
            f"at most {2 * MAX_MULTIPLY_ADDS_PER_PIXEL * pixels / 1e9:,.0f}"
        )


def checked_cost(
    architecture: Architecture, image_size: int, *, images: int = 1, is_in_memory: bool = True
) -> Cost:
    """The cost for `images` of `image_size` x `image_size`; those of other proportions cost less.

    Raises ValueError if it is out of proportion, see `check_proportions`, or, `is_in_memory`, if this machine
    has too little memory.
    """
    cost = cost_of(architecture, (image_size, image_size), images=images)
    try:
        check_proportions(cost)
    except ValueError as error:
        raise ValueError(f"Image size {image_size}: {error}. Use a smaller image_size or model.") from None
    if is_in_memory:
        check_memory(cost, cost.memory_bytes)
    return cost


def check_memory(cost: Cost, needed_bytes: int, *, free_bytes: int | None = None) -> None:
    """Raise ValueError if `needed_bytes` of `cost` exceed `free_bytes`, by default those available now."""
    free = available_bytes() if free_bytes is None else free_bytes
    if free is not None and needed_bytes > free:
        raise ValueError(
            f"Image size {max(cost.size_hw)}: the model needs {megabytes(needed_bytes)} of memory, most of "
            f"it at {cost.layer}, but only {megabytes(free)} are available. Use a smaller image_size or "
            "model."
        )


def _watched(network: Network, counter: CostCounter) -> list[tuple[str, Shape]]:
    """Tell `counter` which layer of `network` is computed; returns the list of outputs, to be filled."""
    names = iter([f"layer {index} ({layer.kind})" for index, layer in enumerate(network.architecture.layers)])
    counter.layer = next(names)
    outputs: list[tuple[str, Shape]] = []

    def note(_: object, __: object, output: ShapeTensor) -> None:
        outputs.append((counter.layer, output.shape))
        counter.layer = next(names)

    for module in network.model[:-1]:
        module.register_forward_hook(note)
    return outputs


def _run(network: Network, pixels: ShapeTensor) -> None:
    """Run `network` up to the selection by NMS."""
    features = cast(list[Any], network.features(cast(Tensor, pixels)))
    levels = cast(list[ShapeTensor], network.head(features))
    rows = [level.made(*level.shape) for level in levels]
    decoded = [level.made(*level.shape) for level in levels]
    finest = features[0]
    del features, levels, rows, pixels
    likely = [level.made(*level.shape) for level in decoded]
    selected = [level.made(*level.shape) for level in likely]
    del selected
    if isinstance(network.head, Segment):
        _prototypes(network.head.proto, finest)
    del likely


def _prototypes(proto: Proto, finest: ShapeTensor) -> None:
    """The memory that `proto` takes when folded, but the arithmetic of its training."""
    trained = CostCounter()
    batch, prototypes, height, width = proto(ShapeTensor(finest.shape, trained)).shape
    finest.counter.multiply_adds += trained.multiply_adds
    hidden, quarters = proto.cv2.conv.out_channels, 4 * prototypes
    # Widened and padded features, then a quarter before its last convolution, or the quarters being shuffled.
    channels = 2 * hidden + max(hidden + quarters, 3 * quarters)
    finest.made(batch, channels, height // 2, width // 2)


def _square(architecture: Architecture, image_size: int) -> tuple[int, int]:
    """The smallest square input that is not smaller than `image_size`."""
    multiple = size_multiple(architecture)
    side = math.ceil(image_size / multiple) * multiple
    return side, side


def megabytes(count: int) -> str:
    """Bytes for a reader, such as "35 MB"."""
    return f"{count / 1e9:,.1f} GB" if count >= 1e9 else f"{count / 1e6:,.0f} MB"
