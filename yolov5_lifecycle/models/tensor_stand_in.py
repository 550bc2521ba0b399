"""What a network's own code runs on in place of a tensor, to learn what it would compute."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import torch


class TensorStandIn:
    """torch's functions call those of `functions` in place of their own code.

    Those without one, which no layer uses, raise NotImplementedError.
    """

    functions: ClassVar[Mapping[Callable[..., object], Callable[..., object]]] = {}
    dtype = torch.float32
    is_nested = False

    @classmethod
    def __torch_function__(
        cls,
        function: Callable[..., object],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> object:
        if function not in cls.functions:
            raise NotImplementedError(f"{function} of {cls.__name__}")
        return cls.functions[function](*args, **(kwargs or {}))
