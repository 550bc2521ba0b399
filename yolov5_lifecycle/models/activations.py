"""Activation functions by their names in architectures."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from types import MappingProxyType

from torch import nn

ACTIVATIONS: Mapping[str, Callable[..., nn.Module]] = MappingProxyType(
    {
        "SiLU": nn.SiLU,
        "Hardswish": nn.Hardswish,
        "LeakyReLU": nn.LeakyReLU,
        "ReLU": nn.ReLU,
        "Identity": nn.Identity,
    }
)
"""By class name in torch; a LeakyReLU has its negative slope in parentheses, as in "LeakyReLU(0.1)"."""
_LEAKY = re.compile(r"LeakyReLU\((0(?:\.\d{1,12})?|1(?:\.0)?)\)")


def activation_of(name: str) -> nn.Module:
    """The module of an activation such as "SiLU" or "LeakyReLU(0.1)"; raises ValueError for others."""
    if leaky := _LEAKY.fullmatch(name):
        return nn.LeakyReLU(float(leaky[1]), inplace=True)
    if name == "Identity":
        return nn.Identity()
    if name not in ACTIVATIONS or name == "LeakyReLU":
        raise ValueError(f"expected an activation, one of {', '.join(ACTIVATIONS)}, found {name[:40]!r}")
    return ACTIVATIONS[name](inplace=True)


def leaky_relu(negative_slope: float) -> str:
    """The name of a LeakyReLU, with at most 12 digits of its slope, which is in [0, 1]."""
    return f"LeakyReLU({f'{negative_slope:.12f}'.rstrip('0').rstrip('.')})"
