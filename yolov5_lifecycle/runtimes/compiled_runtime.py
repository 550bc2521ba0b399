"""Runtime of the ONNX engines, which compile the network for each input shape."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar
from weakref import WeakValueDictionary

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from yolov5_lifecycle.images.image import ChannelOrder
from yolov5_lifecycle.models.head import Detect, Segment
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import fuse
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.runtimes.networks_by_shape import MIN_KEPT, NetworksByShape, Shape, closed
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph, prototype_graph
from yolov5_lifecycle.runtimes.quantization import Quantization, convolutions
from yolov5_lifecycle.runtimes.runtime import InferenceError, Predictions
from yolov5_lifecycle.runtimes.torch_device import DeviceError

_PLANES = {"rgb": (0, 1, 2), "bgr": (2, 1, 0)}
_TO_GREY = {"rgb": cv2.COLOR_RGB2GRAY, "bgr": cv2.COLOR_BGR2GRAY}

Features = NDArray[np.float32]
"""Feature map of one detection level, (batch, channels, ny, nx)."""
Result = TypeVar("Result")

Run = Callable[[NDArray[np.generic]], Sequence[Features]]
"""Planes (batch, 3 or 1, h, w), RGB or grey -> features of each level, which the next run may overwrite.

Or features of the finest level (1, channels, ny, nx) -> prototypes (1, M, h, w).
"""
Loaded = Callable[[], Run]
"""A network in memory: each call creates a run for one thread at a time, with buffers of its own.

The runs share its weights and its `Threads`.
"""


@dataclass(frozen=True)
class Threads:
    """Threads of the processor that a compiled network uses for each of the runs that are made at once.

    By default as many as torch uses.
    """

    each: int = field(default_factory=torch.get_num_threads)
    at_once: int = 1


@dataclass(frozen=True)
class Engine:
    """An inference engine, named like its package; `load` compiles an ONNX model, and may raise `errors`."""

    name: str
    load: Callable[[bytes, Threads], Loaded]
    errors: tuple[type[Exception], ...]
    precision: str = "fp32"


class Program(ABC):
    """What an engine can run for frames of any shape: a model's network, or an export.

    It is loaded once for all runtimes with the same `Threads`, and freed with the last of them.
    """

    def __init__(self, engine: Engine, precision: str) -> None:
        self.engine, self.precision = engine, precision
        self._loading = threading.Lock()
        self._loaded: WeakValueDictionary[tuple[str, Threads], Loaded] = WeakValueDictionary()

    @abstractmethod
    def network(self, shape: Shape, threads: Threads) -> Callable[..., Predictions]:
        """The network for frames of `shape`, called as `Runtime` is; raises the engine's errors.

        It may only be used while denormal floats are zero.
        """

    def shared(self, part: str, threads: Threads, graph: Callable[[], bytes]) -> Loaded:
        """The `part` that a runtime with the same `threads` has loaded, or else its `graph`, loaded."""
        with self._loading:
            found = self._loaded.get((part, threads))
            if found is None:
                found = self._loaded[part, threads] = self.engine.load(graph(), threads)
            return found


class CompiledRuntime:
    """A `program` on the CPU. See `Runtime`; `kept`: see `NetworksByShape`."""

    device = "cpu"

    def __init__(self, program: Program, threads: Threads, *, kept: int = MIN_KEPT) -> None:
        self.name, self.precision = program.engine.name, program.precision
        self._errors = program.engine.errors
        self._kept = kept
        self._program: Program | None = program
        """None once closed."""
        self._networks = NetworksByShape(lambda shape: program.network(shape, threads), kept=kept)

    def __call__(
        self, frame: NDArray[np.uint8], channel_order: ChannelOrder, min_objectness: float = 0.0
    ) -> Predictions:
        """See `Runtime`; the first frame of each size waits for the compiler."""
        shape = frame.shape[0], frame.shape[1]
        predictions = self._using(shape, lambda network: network(frame, channel_order, min_objectness))
        compute = predictions.compute_prototypes
        if compute is None:
            return predictions
        return replace(predictions, compute_prototypes=lambda: self._using(shape, lambda _: compute()))

    def _using(self, shape: Shape, use: Callable[[Callable[..., Predictions]], Result]) -> Result:
        """The result of `use` on the network for frames of `shape`; engine errors become InferenceError."""
        try:
            # Denormal floats are zero in this thread; the engine sees to its own threads.
            with self._networks.running(shape) as network:
                return use(network)
        except InferenceError:  # it was closed, or an export does not mean what it says
            raise
        except self._errors as error:
            problem = in_one_line(str(error).partition("\n")[0])
        raise InferenceError(f"{self.name} failed on {self.device}: {problem}")

    def streams(self, count: int, threads: int) -> list[CompiledRuntime]:
        """See `Runtime`."""
        if (program := self._program) is None:
            raise closed()
        shared = Threads(threads, at_once=count)
        return [CompiledRuntime(program, shared, kept=self._kept) for _ in range(count)]

    def close(self) -> None:
        """See `Runtime`."""
        self._program = None
        self._networks.close()


def check_processor(device: str, engine: Engine, *, otherwise: str = "runtime 'torch'") -> None:
    """Raise DeviceError unless `device` is the one that `engine` supports; `otherwise`: what to use then."""
    if device not in ("auto", "cpu"):
        raise DeviceError(
            f"Runtime '{engine.name}' runs on the CPU only, found device {device[:40]!r}. "
            f"Use device 'cpu' or {otherwise}."
        )


class Compiler(Program):
    """Compiles the network of `model` with `engine`, in int8 with `quantization`.

    `head` is the network's last layer, which is not compiled; `proto` its part that computes mask prototypes,
    None if the network does not segment. Its images have `channels`, 3 or 1.

    Raises QuantizationError if `quantization` belongs to another network.
    """

    def __init__(self, model: Model, engine: Engine, quantization: Quantization | None = None) -> None:
        super().__init__(engine, engine.precision)
        self._model = model
        self._quantization = quantization
        network = model.network().requires_grad_(False)
        if quantization is not None:
            quantization.check(convolutions(network))
        self.channels = model.architecture.image_channels
        self.head = DetectionHead(network.head)
        self.proto = network.head.proto if isinstance(network.head, Segment) else None

    def network(self, shape: Shape, threads: Threads) -> _Compiled:
        """See `Program`."""
        return _Compiled(self, shape, threads)

    def compiled(self, shape: Shape, threads: Threads) -> Loaded:
        """The compiled network for frames of `shape`; raises the engine's errors."""
        return self.shared(str(shape), threads, lambda: self._graph(shape))

    def prototypes(self, finest: Features, threads: Threads) -> Loaded:
        """The compiled `proto` for features like `finest`; raises the engine's errors."""
        proto = self.proto
        assert proto is not None
        _, channels, height, width = finest.shape
        shape = (1, channels, height, width)
        # A frame waits for this: the rest of the network, which takes much longer, is not fused.
        return self.shared(f"prototypes {shape}", threads, lambda: prototype_graph(fuse(proto), shape))

    def _graph(self, shape: Shape) -> bytes:
        """That of a new network: fused weights, which are not the model's, are only needed here."""
        try:
            return onnx_graph(fuse(self._model.network()), shape, self._quantization)
        except ValueError as error:  # the layers do not fit each other for this size
            raise InferenceError(f"{self.engine.name} failed on cpu: {error}") from None


class _Compiled:
    """A compiled network for one input shape, with its input buffer."""

    def __init__(self, compiler: Compiler, shape: Shape, threads: Threads) -> None:
        self._compiler = compiler
        self._threads = threads
        self._loaded = compiler.compiled(shape, threads)
        self._run = self._loaded()
        self._loaded_proto: Loaded | None = None
        self._run_proto: Run | None = None
        self._planes = np.empty((1, compiler.channels, *shape), np.uint8)

    def __call__(
        self, frame: NDArray[np.uint8], channel_order: ChannelOrder, min_objectness: float
    ) -> Predictions:
        """See `Runtime`; the next run may overwrite the features from which prototypes are computed."""
        write_planes(frame, channel_order, self._planes[0])
        features = self._run(self._planes)
        return Predictions(
            self._compiler.head(features, min_objectness),
            partial(self._prototypes, features[0]) if self._compiler.proto is not None else None,
            partial(_mean, features[-1]),
        )

    def _prototypes(self, finest: Features) -> NDArray[np.float32]:
        """Prototypes (M, h, w) from the features of the finest level."""
        if self._run_proto is None:
            self._loaded_proto = self._compiler.prototypes(finest, self._threads)
            self._run_proto = self._loaded_proto()
        (found,) = self._run_proto(finest)
        prototypes: NDArray[np.float32] = found[0].copy()  # the next run may overwrite them
        return prototypes


def _mean(features: Features) -> NDArray[np.float32]:
    """The mean (channels,) over all cells of one frame's features (1, channels, ny, nx)."""
    mean: NDArray[np.float32] = features[0].mean(axis=(1, 2), dtype=np.float32)
    return mean


def write_planes(frame: NDArray[np.uint8], channel_order: ChannelOrder, planes: NDArray[np.uint8]) -> None:
    """Write a frame (h, w, 3), or (h, w) if it is grey, into `planes`: (3, h, w) RGB or (1, h, w) grey."""
    if channel_order == "grey":
        planes[:] = frame
    elif len(planes) == 1:
        cv2.cvtColor(frame, _TO_GREY[channel_order], dst=planes[0])
    else:
        cv2.split(frame, [planes[plane] for plane in _PLANES[channel_order]])


class DetectionHead:
    """`Detect` and `Segment` in numpy: of 15,120 predictions per image, at most about 300 are evaluated.

    Evaluating all would be a twelfth of the network's arithmetic and 5 MB to convert and pass on: together a
    fifth of the time of yolov5n at 384x640.
    """

    def __init__(self, detect: Detect) -> None:
        self._levels = [
            _Level(convolution, anchors, stride, detect)
            for convolution, anchors, stride in zip(detect.m, detect.anchors, detect.strides, strict=True)
        ]

    def __call__(self, features: Sequence[Features], min_objectness: float) -> NDArray[np.float32]:
        """The rows specified by `Runtime`, all anchors of a cell at once, from the features of one image."""
        with np.errstate(all="ignore"):  # NaN propagates to the caller, which checks the rows
            min_logit = np.log(min_objectness) - np.log1p(-min_objectness)
            rows = [
                level.rows(known, np.flatnonzero(~(level.objectness(known) < min_logit)))
                for level, known in zip(self._levels, features, strict=True)
            ]
        return np.concatenate(rows)


class _Level:
    """The 1x1 convolution of one level and the decoding of its output."""

    def __init__(self, convolution: nn.Module, anchors: Tensor, stride: int, detect: Detect) -> None:
        assert isinstance(convolution, nn.Conv2d)
        assert convolution.bias is not None
        shape = (len(anchors), detect.outputs, -1)
        self._weights = convolution.weight.numpy().reshape(shape)  # (anchors, outputs, channels)
        self._bias = convolution.bias.numpy().reshape(shape)  # (anchors, outputs, 1)
        self._anchors_px = anchors.numpy()[:, None] * np.float32(stride)  # (anchors, 1, 2)
        self._stride = stride
        self._bounded = detect.outputs - detect.coefficients

    def objectness(self, features: Features) -> NDArray[np.float32]:
        """The highest objectness logit of every cell, (ny * nx)."""
        logits = self._weights[:, 4] @ features.reshape(features.shape[1], -1) + self._bias[:, 4]
        highest: NDArray[np.float32] = logits.max(axis=0)
        return highest

    def rows(self, features: Features, cells: NDArray[np.intp]) -> NDArray[np.float32]:
        """Predictions (anchors * n, outputs) of n cells; formula: see `Detect.decode`."""
        _, channels, _, nx = features.shape
        logits = self._weights @ features.reshape(channels, -1)[:, cells] + self._bias
        rows = np.ascontiguousarray(logits.transpose(0, 2, 1))  # (anchors, n, outputs)
        sigma = rows[..., : self._bounded]  # all but the coefficients of masks
        sigma[:] = 1 / (1 + np.exp(-sigma))
        cells_xy = np.stack((cells % nx, cells // nx), axis=-1).astype(np.float32)
        sigma[..., :2] = (2 * sigma[..., :2] - 0.5 + cells_xy) * self._stride
        sigma[..., 2:4] = (2 * sigma[..., 2:4]) ** 2 * self._anchors_px
        predictions: NDArray[np.float32] = rows.reshape(-1, rows.shape[2])
        return predictions
