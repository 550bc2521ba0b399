"""What a weights file holds, and the rules every file must keep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from yolov5_lifecycle.architecture import Architecture
from yolov5_lifecycle.network import Network

MAX_CLASSES = 10_000
MAX_NAME_LENGTH = 200


class WeightsError(ValueError):
    """A weights file is refused; the message says what was expected, what was found and what to do."""


@dataclass(frozen=True, eq=False)
class Model:
    """A network's shape, the names of its classes and its tensors; made by `checked_model`.

    `state_dict` loads strictly into `Network(architecture)`: CPU tensors of their own memory, float32 or
    integer.
    """

    architecture: Architecture
    class_names: tuple[str, ...]
    state_dict: Mapping[str, Tensor]


def checked_model(
    architecture: Architecture, class_names: tuple[str, ...], tensors: Mapping[str, Tensor]
) -> Model:
    """The model of tensors whose keys and shapes fit `architecture` and whose numbers are finite.

    Nothing is allocated before everything fits. Raises WeightsError.
    """
    expected = _expected_shapes(architecture)
    for key, shape in expected.items():
        if key not in tensors:
            raise WeightsError(f"the tensor {key} is missing")
        if tensors[key].shape != shape:
            raise WeightsError(
                f"the tensor {key} has the shape {tuple(tensors[key].shape)}, expected {tuple(shape)}"
            )
    if unexpected := [key for key in tensors if key not in expected]:
        raise WeightsError(f"the tensor {unexpected[0][:80]} belongs to no layer of the network")
    for key, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise WeightsError(f"the tensor {key} has numbers that are not finite (NaN or infinity)")
    return Model(architecture, class_names, {key: _own(tensor) for key, tensor in tensors.items()})


def check_class_names(names: object, classes: int) -> tuple[str, ...]:
    """Names from a list, or a dict by index; raises WeightsError unless there are `classes` of them."""
    if isinstance(names, dict):
        names = [names.get(index) for index in range(len(names))]
    if not isinstance(names, (list, tuple)) or len(names) != classes:
        count = f"{len(names)} names" if isinstance(names, (list, tuple)) else f"a {type(names).__name__}"
        raise WeightsError(f"expected names of {classes} classes, found {count}")
    for name in names:
        if not isinstance(name, str) or not 1 <= len(name) <= MAX_NAME_LENGTH or not name.isprintable():
            raise WeightsError(
                f"{str(name)[:40]!r} is no class name of 1 to {MAX_NAME_LENGTH} printable characters"
            )
    return tuple(names)


def _expected_shapes(architecture: Architecture) -> dict[str, torch.Size]:
    try:
        with torch.device("meta"):
            return {key: tensor.shape for key, tensor in Network(architecture).state_dict().items()}
    except (RuntimeError, IndexError, TypeError, ValueError) as error:
        raise WeightsError(
            f"no network can be built from its layers: {str(error).splitlines()[0][:200]}"
        ) from None


def _own(tensor: Tensor) -> Tensor:
    own = tensor.detach().to(torch.float32) if tensor.is_floating_point() else tensor.detach()
    return own.clone(memory_format=torch.contiguous_format)
