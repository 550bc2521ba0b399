"""The network run by torch itself."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from yolov5_lifecycle.images import Order
from yolov5_lifecycle.model import Model
from yolov5_lifecycle.network import Network, fuse
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.runtimes.torch_device import resolve_device, resolve_precision

_PRECISION_NAMES = {torch.float32: "fp32", torch.float16: "fp16"}


class TorchRuntime:
    """A fused network in channels-last layout. Takes `network` over: it is changed and moved to the device."""

    name = "torch"

    def __init__(self, network: Network, *, device: torch.device, dtype: torch.dtype) -> None:
        self._device = device
        self._dtype = dtype
        fuse(network)
        for module in network.modules():
            if isinstance(module, nn.Conv2d):  # the anchors stay in full precision
                module.to(dtype)
        self._network: Network | None = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]

    @classmethod
    def load(cls, model: Model, *, device: str, precision: str) -> TorchRuntime:
        """Build the network of `model` on a device as named in the settings; raises DeviceError."""
        torch_device = resolve_device(device)
        dtype = resolve_precision(precision, torch_device)
        with torch.device("meta"):  # nothing is allocated or initialised twice
            network = Network(model.architecture)
        network.load_state_dict(model.state_dict, assign=True)
        return cls(network, device=torch_device, dtype=dtype)

    @property
    def device(self) -> str:
        return str(self._device)

    @property
    def precision(self) -> str:
        return _PRECISION_NAMES[self._dtype]

    def __call__(self, frame: NDArray[np.uint8], order: Order) -> NDArray[np.float32]:
        """See `Runtime`."""
        if self._network is None:
            raise InferenceError("The runtime was closed; load the model again.")
        with torch.inference_mode():
            raw: NDArray[np.float32] = self._network(self._pixels(frame, order))[0].cpu().numpy()
        return raw

    def close(self) -> None:
        """See `Runtime`."""
        self._network = None

    def _pixels(self, frame: NDArray[np.uint8], order: Order) -> torch.Tensor:
        """(h, w, 3) uint8 -> (1, 3, h, w) RGB in [0, 1], already in channels-last layout."""
        rgb = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB) if order == "bgr" else frame
        pixels = torch.from_numpy(rgb).to(self._device).permute(2, 0, 1).unsqueeze(0)
        return pixels.to(self._dtype) / 255
