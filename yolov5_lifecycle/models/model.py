"""What weights files hold, a model or an export, and the validation of a model's contents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.class_names import ClassNamesError, class_names_of
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.printable import in_one_line

MAX_CLASSES = 10_000
DTYPES = frozenset({torch.float32, torch.float16, torch.bfloat16, torch.float64, torch.int64, torch.int32})
"""What the tensors of a weights file may hold."""
_MAX_SHOWN = 60


class WeightsError(ValueError):
    """A rejected weights file; the message states what was expected, what was found and what to do."""


class UncheckedError(WeightsError):
    """A weights file that could not be validated in this environment; it may be valid."""


@dataclass(frozen=True, eq=False)
class Model:
    """Architecture, class names and tensors of a network; created by `checked_model`.

    `state_dict` loads strictly into `Network(architecture)`: contiguous CPU tensors that own their memory,
    float32 or int64.
    """

    architecture: Architecture
    class_names: tuple[str, ...]
    state_dict: Mapping[str, Tensor]

    def network(self) -> Network:
        """A network that shares the tensors of the model."""
        network = blueprint(self.architecture)  # without initial values, which would be replaced at once
        network.load_state_dict(self.state_dict, assign=True)
        return network


@dataclass(frozen=True, eq=False)
class Export:
    """A model that was exported to ONNX, which is run as it is, and what its inputs and outputs mean.

    The graph reads images (batch, `channels`, h, w) in [0, 1], RGB or grey, of float32 or, if it `is_half`,
    float16. Its boxes are (batch, N, 5 + C + M) with objectness, as those of YOLOv5, or without it
    (batch, 4 + C + M, N), as those of YOLOv5u and later: cx, cy, w, h in pixels, scores in [0, 1],
    coefficients of masks. Its prototypes are (batch, M, h, w).
    """

    graph: bytes
    class_names: tuple[str, ...]
    channels: int
    stride: int
    """Height and width of images are multiples of it."""
    is_half: bool
    has_objectness: bool
    mask_coefficients: int
    """M, 0 for a model that does not segment."""
    boxes: int
    """Which of the outputs they are."""
    prototypes: int | None
    size_hw: tuple[int, int] | None
    """The only size of its images; None for any."""
    batch: int | None
    """The only number of images in a run; None for any."""

    @property
    def precision(self) -> str:
        return "fp16" if self.is_half else "fp32"


def checked_model(
    architecture: Architecture, class_names: tuple[str, ...], tensors: Mapping[str, Tensor]
) -> Model:
    """Validate keys, shapes and values of `tensors` against `architecture` and create the model.

    Allocates only after all keys and shapes match. Raises WeightsError.
    """
    expected = blueprint(architecture).state_dict()
    check_fit(expected, tensors)
    state_dict = {key: _own(tensors[key]) for key in expected}
    for key, tensor in state_dict.items():
        _check_numbers(key, tensor)
    _check_anchors(architecture, state_dict)
    return Model(architecture, class_names, state_dict)


def blueprint(architecture: Architecture) -> Network:
    """The network of `architecture` on the meta device; raises WeightsError if it cannot be built."""
    try:
        with torch.device("meta"):
            return Network(architecture)
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise WeightsError(f"no network can be built from its layers: {first_line(error)}") from None


def check_class_names(
    names: object, classes: int, *, remedy: str = "set model.names and save the checkpoint again"
) -> tuple[str, ...]:
    """The names of `classes` classes, as `class_names_of` gives them; raises WeightsError with the remedy."""
    try:
        return class_names_of(names, classes, classes)
    except ClassNamesError as error:
        raise WeightsError(f"{error}: {remedy}") from None


def checked_integer(value: object, what: str, least: int, most: int) -> int:
    """Return `value` if it is an int in [`least`, `most`]; else raise WeightsError naming `what`."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise WeightsError(f"{what}: expected an integer from {least} to {most}, found {shown(value)}")
    return value


def shown(value: object) -> str:
    """Short one-line text of a value from a file, for messages, whatever its size or nesting."""
    if isinstance(value, (list, tuple)):
        more = ", ..." if len(value) > 8 else ""
        return f"[{', '.join(_shown_scalar(item) for item in value[:8])}{more}]"
    return _shown_scalar(value)


def first_line(error: BaseException) -> str:
    """Type and first line of an error of another library."""
    return f"{type(error).__name__}: {in_one_line(str(error).partition(chr(10))[0])[:200]}"


def _shown_scalar(value: object) -> str:
    if not isinstance(value, (str, int, float, type(None))):
        return f"a {type(value).__name__[:_MAX_SHOWN]}"
    text = repr(value[:_MAX_SHOWN] if isinstance(value, str) else value)
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


def check_fit(expected: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> None:
    """Raise WeightsError unless `tensors` match the keys, shapes and kinds of dtype of a state dict.

    Values are not read: both may be on the meta device.
    """
    for key, blank in expected.items():
        if key not in tensors:
            raise WeightsError(
                f"the tensor {key} is missing: the file is incomplete; copy or convert it again"
            )
        found = tensors[key]
        if found.shape != blank.shape:
            raise WeightsError(
                f"the tensor {key} has the shape {tuple(found.shape)}, expected {tuple(blank.shape)}"
            )
        if found.dtype not in DTYPES or found.is_floating_point() != blank.is_floating_point():
            raise WeightsError(f"the tensor {key} holds {found.dtype}, expected {blank.dtype}")
    if unexpected := next((key for key in tensors if key not in expected), None):
        raise WeightsError(f"the tensor {shown(unexpected)} belongs to no layer of the network")


def _own(tensor: Tensor) -> Tensor:
    dtype = torch.float32 if tensor.is_floating_point() else torch.int64
    return tensor.detach().to("cpu", dtype, copy=True, memory_format=torch.contiguous_format)


def _check_numbers(key: str, tensor: Tensor) -> None:
    if not bool(torch.isfinite(tensor).all()):
        raise WeightsError(f"the tensor {key} has numbers that are not finite (NaN or infinity)")
    if key.endswith(".running_var") and bool((tensor < 0).any()):
        raise WeightsError(f"the tensor {key} has negative variances: the file is damaged")


def _check_anchors(architecture: Architecture, state_dict: Mapping[str, Tensor]) -> None:
    """Check the head's anchors (grid cells) against those of the architecture (pixels)."""
    anchors = state_dict[f"model.{len(architecture.layers) - 1}.anchors"]
    if not bool((anchors > 0).all()):
        raise WeightsError("expected anchors of positive width and height, found others")
    strides = torch.tensor(architecture.strides).view(-1, 1, 1)
    if not torch.allclose(anchors * strides, torch.tensor(architecture.anchors_px).float(), rtol=1e-3):
        raise WeightsError("the anchors of the last layer are not those of the architecture")
