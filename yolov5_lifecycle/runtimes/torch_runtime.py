"""The network run by torch itself."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from yolov5_lifecycle.images import Order
from yolov5_lifecycle.model import Model
from yolov5_lifecycle.network import Network, fuse
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError
from yolov5_lifecycle.runtimes.torch_device import DeviceError, resolve_device, resolve_precision

_PRECISIONS = {torch.float32: "fp32", torch.float16: "fp16"}


class TorchRuntime:
    """A fused network in channels-last layout. Takes `network` over: fuses, converts and moves it."""

    name = "torch"

    def __init__(self, network: Network, *, device: torch.device, dtype: torch.dtype) -> None:
        self._device = device
        self._dtype = dtype
        self._network: Network | None = _prepared(network, device, dtype)

    @classmethod
    def load(cls, model: Model, *, device: str, precision: str) -> TorchRuntime:
        """The network of `model` on the device and in the precision that the settings' words name.

        Raises DeviceError, also when the device has no room for the network.
        """
        torch_device = resolve_device(device)
        dtype = resolve_precision(precision, torch_device)
        with torch.device("meta"):  # no time and memory for values that are replaced at once
            network = Network(model.architecture)
        network.load_state_dict(model.state_dict, assign=True)
        try:
            return cls(network, device=torch_device, dtype=dtype)
        except (torch.OutOfMemoryError, torch.AcceleratorError) as error:
            problem = _first_line(error)
        raise DeviceError(
            f"Device '{torch_device}' does not take the network: {problem} "
            "Use a smaller model or device 'cpu'."
        )

    @property
    def device(self) -> str:
        return str(self._device)

    @property
    def precision(self) -> str:
        return _PRECISIONS[self._dtype]

    def __call__(self, frame: NDArray[np.uint8], order: Order) -> NDArray[np.float32]:
        """See `Runtime`; DeviceLostError when CUDA has given this process up."""
        if self._network is None:
            raise InferenceError("The runtime was closed; load the model again.")
        try:
            return self._run(self._network, frame, order)
        except torch.OutOfMemoryError as error:
            problem = f"{_first_line(error)} Use a smaller image_size or model."
        except RuntimeError as error:
            problem = _first_line(error)
        # Only outside the except block are the tensors of this frame free (pytorch/pytorch#18853).
        raise self._failure(problem)

    def close(self) -> None:
        """See `Runtime`."""
        self._network = None

    @torch.inference_mode()
    def _run(self, network: Network, frame: NDArray[np.uint8], order: Order) -> NDArray[np.float32]:
        raw: NDArray[np.float32] = network(self._pixels(frame, order))[0].cpu().numpy()
        return raw

    def _pixels(self, frame: NDArray[np.uint8], order: Order) -> Tensor:
        """(h, w, 3) uint8 -> (1, 3, h, w) RGB in [0, 1], in channels-last layout because it comes so."""
        rgb = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB) if order == "bgr" else frame
        pixels = torch.from_numpy(rgb).to(self._device).permute(2, 0, 1).unsqueeze(0)
        return pixels.to(self._dtype) / 255

    def _failure(self, problem: str) -> InferenceError:
        """What to raise for a failed frame; the device is tried, as some errors of CUDA are for ever."""
        failure = f"torch failed on {self.device}: {problem}"
        if self._device.type == "cuda":
            try:
                torch.cuda.synchronize(self._device)
                torch.cuda.empty_cache()
            except RuntimeError:
                return DeviceLostError(f"{failure} The device is lost to this process; start it again.")
        return InferenceError(failure)


def _prepared(network: Network, device: torch.device, dtype: torch.dtype) -> Network:
    fuse(network)
    for module in network.modules():
        if isinstance(module, nn.Conv2d):  # the anchors stay float32
            module.to(dtype)
    network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network


def _first_line(error: RuntimeError) -> str:
    """torch appends its C++ stack and advice about environment variables."""
    return str(error).partition("\n")[0]
