"""Torch runtime, on CPU or GPU."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from yolov5_lifecycle.images.image import ChannelOrder
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import Network, fuse
from yolov5_lifecycle.runtimes.networks_by_shape import (
    MIN_KEPT,
    NetworksByShape,
    Shape,
    closed,
)
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError, Predictions
from yolov5_lifecycle.runtimes.torch_device import DeviceError, resolve_device, resolve_precision

_PRECISIONS = {torch.float32: "fp32", torch.float16: "fp16"}
_TO_GREY = {"rgb": cv2.COLOR_RGB2GRAY, "bgr": cv2.COLOR_BGR2GRAY}
_TO_RGB = {"bgr": cv2.COLOR_BGR2RGB, "grey": cv2.COLOR_GRAY2RGB}

_WARM_UPS = 3  # libraries select algorithms and allocate memory, which is not allowed during capture
_CAPTURE_PATIENCE_S = 10.0
_ONE_AT_A_TIME = threading.Lock()
_HAS_FAILED = threading.Event()

Forward = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
"""Frames (batch, h, w, 3) RGB or (batch, h, w, 1) grey -> all predictions (batch, N, 5 + C + M), and the
features of the finest and of the coarsest level (batch, channels, ny, nx). The next run may overwrite them.
"""

Result = TypeVar("Result")

_log = logging.getLogger(__name__)


class TorchRuntime:
    """A `network` that is `prepared`, for one thread; others may share the network.

    `kept`: see `NetworksByShape`. `threads`: how many of the processor torch uses in a run, and after it;
    None: as many as it uses in the calling thread.
    """

    name = "torch"

    def __init__(
        self,
        network: Network,
        *,
        device: torch.device,
        dtype: torch.dtype,
        kept: int = MIN_KEPT,
        threads: tuple[int, int] | None = None,
    ) -> None:
        self._network: Network | None = network
        """None once closed."""
        self._device = device
        self._dtype = dtype
        self._kept = kept
        self._threads = threads
        self._channels = network.architecture.image_channels
        self._proto = network.head.proto if isinstance(network.head, Segment) else None
        self._forwards = NetworksByShape(
            lambda shape: _forward(network, shape, device=device, dtype=dtype), kept=kept
        )

    @classmethod
    def load(cls, model: Model, *, device: str, precision: str, kept: int = MIN_KEPT) -> TorchRuntime:
        """Load `model` on the device and in the precision of the settings; `kept`: see `NetworksByShape`.

        Raises DeviceError, also when the device runs out of memory, and DeviceLostError.
        """
        torch_device = resolve_device(device)
        dtype = resolve_precision(precision, torch_device)
        try:
            network = prepared(model.network(), torch_device, dtype)
            return cls(network, device=torch_device, dtype=dtype, kept=kept)
        except (torch.OutOfMemoryError, torch.AcceleratorError) as error:
            problem = _first_line(error)
        if _is_lost(torch_device):
            raise DeviceLostError(_lost(torch_device, problem))
        raise DeviceError(
            f"Device '{torch_device}' cannot load the network: {problem} Use a smaller model or device 'cpu'."
        )

    @property
    def device(self) -> str:
        return str(self._device)

    @property
    def precision(self) -> str:
        return _PRECISIONS[self._dtype]

    def __call__(
        self, frame: NDArray[np.uint8], channel_order: ChannelOrder, min_objectness: float = 0.0
    ) -> Predictions:
        """See `Runtime`; DeviceLostError when CUDA no longer works in this process."""
        shape = frame.shape[0], frame.shape[1]

        def predict(forward: Forward) -> Predictions:
            pixels = torch.from_numpy(_as_channels(frame, channel_order, self._channels))
            (raw,), finest, coarsest = forward(pixels.unsqueeze(0))
            return Predictions(
                _likely(raw, min_objectness),
                self._prototypes(shape, finest),
                self._embedding(shape, coarsest[0]),
            )

        return self._using(shape, predict)

    def _prototypes(self, shape: Shape, finest: Tensor) -> Callable[[], NDArray[np.float32]] | None:
        """Computes prototypes from the features of the finest level, (1, channels, ny, nx)."""
        if (proto := self._proto) is None:
            return None
        return lambda: self._using(shape, lambda _: proto(finest)[0].float().cpu().numpy())

    def _embedding(self, shape: Shape, coarsest: Tensor) -> Callable[[], NDArray[np.float32]]:
        """Computes the mean over all cells of the features of the coarsest level, (channels, ny, nx)."""
        return lambda: self._using(shape, lambda _: coarsest.float().mean(dim=(1, 2)).cpu().numpy())

    def _using(self, shape: Shape, use: Callable[[Forward], Result]) -> Result:
        """The result of `use` on the network for frames of `shape`; torch errors become InferenceError."""
        try:
            with torch.inference_mode(), _threads(self._threads), self._forwards.running(shape) as forward:
                return use(forward)
        except InferenceError:  # it was closed
            raise
        except torch.OutOfMemoryError as error:
            problem = f"{_first_line(error)} Use a smaller image_size or model."
        except RuntimeError as error:
            problem = _first_line(error)
        # The tensors of this frame are freed only outside the except block (pytorch/pytorch#18853).
        raise self._failure(problem)

    def streams(self, count: int, threads: int) -> list[TorchRuntime]:
        """See `Runtime`; from now on this one uses as many threads as torch does in the calling thread."""
        if self._device.type != "cpu":
            raise DeviceError(
                f"Device '{self._device}' runs one frame at a time: set parallel_frames to 0 or 1."
            )
        total = torch.get_num_threads()
        # A thread that begins while a stream runs has the number of threads of the stream.
        self._threads = (total, total)
        if (network := self._network) is None:
            raise closed()
        stream = partial(TorchRuntime, network, device=self._device, dtype=self._dtype, kept=self._kept)
        return [stream(threads=(threads, total)) for _ in range(count)]

    def close(self) -> None:
        """See `Runtime`."""
        self._network = None
        self._forwards.close()

    def _failure(self, problem: str) -> InferenceError:
        """The error to raise for a failed run."""
        if _is_lost(self._device):
            return DeviceLostError(_lost(self._device, problem))
        if self._device.type == "cuda":
            torch.cuda.empty_cache()
        return InferenceError(f"torch failed on {self.device}: {problem}")


@contextmanager
def _threads(of_run_and_after: tuple[int, int] | None) -> Iterator[None]:
    """Let torch use the first number of threads in the block, the second after it; None changes nothing.

    That is in this thread, and in those that begin until the next change.
    """
    if of_run_and_after is None:
        yield
        return
    of_run, after = of_run_and_after
    torch.set_num_threads(of_run)
    try:
        yield
    finally:
        torch.set_num_threads(after)


def _as_channels(frame: NDArray[np.uint8], channel_order: ChannelOrder, channels: int) -> NDArray[np.uint8]:
    """A frame (h, w, 3), or (h, w) if it is grey, as (h, w, 3) RGB or as (h, w, 1) grey; copied if needed."""
    if channels == 1:
        grey = frame if channel_order == "grey" else cv2.cvtColor(frame, _TO_GREY[channel_order])
        return np.asarray(grey, np.uint8)[..., None]
    return (
        frame if channel_order == "rgb" else np.asarray(cv2.cvtColor(frame, _TO_RGB[channel_order]), np.uint8)
    )


def _forward(network: Network, shape: Shape, *, device: torch.device, dtype: torch.dtype) -> Forward:
    """Forward pass of `network` on uint8 frames (1, h, w, channels), as a CUDA graph where possible."""

    def eager(frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # The frames are channels-last already.
        pixels = frames.to(device).permute(0, 3, 1, 2).to(dtype) / 255
        features = network.features(pixels)
        return network.predictions(features), features[0], features[-1]

    if device.type != "cuda":
        return eager
    try:
        return RecordedNetwork(eager, (1, *shape, network.architecture.image_channels), device)
    except RuntimeError as error:
        problem = _first_line(error.__context__ or error)  # the latter may only mention an earlier error
    _log.warning("The network runs without a CUDA graph, because capturing one failed: %s", problem)
    return eager


def _likely(raw: Tensor, min_objectness: float) -> NDArray[np.float32]:
    """The rows of `raw` whose objectness is not below `min_objectness`; NaN rows are kept."""
    # Filtered on the device, as all rows would be 8 MB to copy from a GPU.
    rows: NDArray[np.float32] = raw[~(raw[:, 4] < min_objectness)].cpu().numpy()
    return rows


def prepared(network: Network, device: torch.device, dtype: torch.dtype) -> Network:
    """`network`, fused, in `dtype` but for its anchors, channels-last and on `device`."""
    fuse(network)
    for module in (*network.model[:-1], *network.head.children()):  # the anchors stay float32
        module.to(dtype)
    if device.type == "cuda" and dtype == torch.float32:  # else convolutions use TF32, as coarse as fp16
        torch.backends.cudnn.allow_tf32 = False
    network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network


def _is_lost(device: torch.device) -> bool:
    """Whether CUDA failed permanently: then even synchronizing the stream fails."""
    if device.type != "cuda":
        return False
    try:
        torch.cuda.current_stream(device).synchronize()  # not the whole device, where a thread may capture
    except RuntimeError:
        return True
    return False


def _lost(device: torch.device, problem: str) -> str:
    return f"torch failed on {device}: {problem} The device is lost; restart this process."


def _first_line(error: BaseException) -> str:
    """First line of an error; torch appends its C++ stack and advice on environment variables."""
    return str(error).partition("\n")[0]


class RecordedNetwork:
    """A CUDA graph of `forward` for uint8 frames (batch, h, w, channels): one launch for all kernels.

    Raises RuntimeError when `forward` fails or cannot be captured.
    """

    def __init__(self, forward: Forward, shape: tuple[int, ...], device: torch.device) -> None:
        self._frames = torch.zeros(shape, dtype=torch.uint8, device=device)
        with _alone(), torch.cuda.device(device):
            self._graph = torch.cuda.CUDAGraph()
            # torch's default capture stream belongs to the first GPU that captured, and stays the current
            # stream after a failed capture.
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UPS):
                    forward(self._frames)
                # thread_local, as other threads may allocate GPU memory meanwhile, e.g. to load a model.
                recording = torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local")
                with _last_if_it_fails(), recording:
                    self._predictions = forward(self._frames)
            torch.cuda.current_stream().wait_stream(stream)

    def __call__(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The output of `forward`, in memory that the next run overwrites."""
        self._frames.copy_(frames)
        self._graph.replay()
        return self._predictions


@contextmanager
def _alone() -> Iterator[None]:
    """Allow one capture at a time per process, as torch requires, and none after a failed one."""
    if not _ONE_AT_A_TIME.acquire(timeout=_CAPTURE_PATIENCE_S):
        raise RuntimeError(f"Another CUDA graph capture has not ended within {_CAPTURE_PATIENCE_S:g} s.")
    try:
        if _HAS_FAILED.is_set():
            raise RuntimeError("An earlier CUDA graph capture in this process failed.")
        yield
    finally:
        _ONE_AT_A_TIME.release()


@contextmanager
def _last_if_it_fails() -> Iterator[None]:
    """Disable capture after a failure, which corrupts the allocator state (pytorch/pytorch#180395)."""
    try:
        yield
    except torch.OutOfMemoryError:  # leaves the allocator intact
        raise
    except RuntimeError:
        _HAS_FAILED.set()
        raise
