"""Refusals, which are the right answer to bad input."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

Taken = TypeVar("Taken")
Refusal = TypeVar("Refusal", bound=Exception)


def taken(take: Callable[[], Taken], refusal: type[Refusal]) -> Taken | Refusal:
    """The result of `take`, or the `refusal` that it raises; any other exception propagates."""
    try:
        return take()
    except refusal as error:
        return error
