"""What a weights file holds, and the rules every file must keep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from yolov5_lifecycle.architecture import Architecture
from yolov5_lifecycle.network import Network
from yolov5_lifecycle.one_line import in_one_line

MAX_CLASSES = 10_000
MAX_NAME_LENGTH = 200
_MAX_SHOWN = 60


class WeightsError(ValueError):
    """A weights file is refused; the message says what was expected, what was found and what to do."""


class UncheckedError(WeightsError):
    """A weights file cannot be read here and now, whatever it holds: it may be good."""


@dataclass(frozen=True, eq=False)
class Model:
    """A network's shape, the names of its classes and its tensors; made by `checked_model`.

    `state_dict` loads strictly into `Network(architecture)`: contiguous CPU tensors of their own memory,
    float32 or int64.
    """

    architecture: Architecture
    class_names: tuple[str, ...]
    state_dict: Mapping[str, Tensor]

    def network(self) -> Network:
        """A network whose tensors are those of the model, not copies."""
        network = blueprint(self.architecture)  # no time and memory for values that are replaced at once
        network.load_state_dict(self.state_dict, assign=True)
        return network


def checked_model(
    architecture: Architecture, class_names: tuple[str, ...], tensors: Mapping[str, Tensor]
) -> Model:
    """The model of tensors whose keys and shapes fit `architecture` and whose numbers make sense.

    Nothing is allocated before everything fits. Raises WeightsError.
    """
    expected = blueprint(architecture).state_dict()
    _check_fit(expected, tensors)
    state_dict = {key: _own(tensors[key]) for key in expected}
    for key, tensor in state_dict.items():
        _check_numbers(key, tensor)
    _check_anchors(architecture, state_dict)
    return Model(architecture, class_names, state_dict)


def blueprint(architecture: Architecture) -> Network:
    """The network of `architecture`, its tensors without memory; raises WeightsError if there is none."""
    try:
        with torch.device("meta"):
            return Network(architecture)
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise WeightsError(f"no network can be built from its layers: {first_line(error)}") from None


def check_class_names(names: object, classes: int) -> tuple[str, ...]:
    """Names from a list, or a dict by index; raises WeightsError unless there are `classes` of them."""
    if isinstance(names, dict):
        if any(index not in names for index in range(len(names))):
            raise WeightsError(f"expected class names numbered from 0 to {len(names) - 1}, found other keys")
        names = [names[index] for index in range(len(names))]
    if not isinstance(names, (list, tuple)) or len(names) != classes:
        found = f"{len(names)} names" if isinstance(names, (list, tuple)) else shown(names)
        raise WeightsError(f"expected names of {classes} classes, found {found}")
    for name in names:
        if not isinstance(name, str) or not 1 <= len(name) <= MAX_NAME_LENGTH or not name.isprintable():
            raise WeightsError(
                f"expected class names of 1 to {MAX_NAME_LENGTH} printable characters, found {shown(name)}"
            )
    return tuple(names)


def whole_number(value: object, what: str, least: int, most: int) -> int:
    """`value` if it is an int from `least` to `most`, else WeightsError names `what`."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise WeightsError(f"{what}: expected a whole number from {least} to {most}, found {shown(value)}")
    return value


def shown(value: object) -> str:
    """What a file holds, fit for a message: a few words of one line, however large or nested it is."""
    if isinstance(value, (list, tuple)):
        more = ", ..." if len(value) > 8 else ""
        return f"[{', '.join(_shown_scalar(item) for item in value[:8])}{more}]"
    return _shown_scalar(value)


def first_line(error: BaseException) -> str:
    """The kind and the first line of what another library says."""
    return f"{type(error).__name__}: {in_one_line(str(error).partition(chr(10))[0])[:200]}"


def _shown_scalar(value: object) -> str:
    if not isinstance(value, (str, int, float, type(None))):
        return f"a {type(value).__name__[:_MAX_SHOWN]}"
    text = repr(value[:_MAX_SHOWN] if isinstance(value, str) else value)
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


def _check_fit(expected: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> None:
    for key, blank in expected.items():
        if key not in tensors:
            raise WeightsError(
                f"the tensor {key} is missing: the file is not whole; copy or convert it again"
            )
        found = tensors[key]
        if found.shape != blank.shape:
            raise WeightsError(
                f"the tensor {key} has the shape {tuple(found.shape)}, expected {tuple(blank.shape)}"
            )
        if found.is_floating_point() != blank.is_floating_point() or found.is_complex():
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
    """The anchors of the Detect layer, in grid cells, are those of the architecture, in pixels."""
    anchors = state_dict[f"model.{len(architecture.layers) - 1}.anchors"]
    if not bool((anchors > 0).all()):
        raise WeightsError("expected anchors of positive width and height, found others")
    strides = torch.tensor(architecture.strides).view(-1, 1, 1)
    if not torch.allclose(anchors * strides, torch.tensor(architecture.anchors_px).float(), rtol=1e-3):
        raise WeightsError("the anchors of the Detect layer are not those of the architecture")
