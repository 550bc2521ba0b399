"""The instructions that a pickle is made of, listed without executing them."""

from __future__ import annotations

import pickletools
from collections.abc import Iterator
from typing import Any, NamedTuple

from yolov5_lifecycle.model import WeightsError, first_line

MAX_OPERATIONS = 1_000_000
"""yolov5n has a thirtieth; an x6 with its averaged copy and its optimizer a third."""


class Operation(NamedTuple):
    name: str
    argument: Any


def operations(pickle: bytes) -> Iterator[Operation]:
    """Operations up to STOP; raises WeightsError when it is not there or too far away."""
    try:
        for count, (code, argument, _) in enumerate(pickletools.genops(pickle)):
            if count == MAX_OPERATIONS:
                raise WeightsError(f"its pickle has more than {MAX_OPERATIONS} operations")
            yield Operation(code.name, argument)
    except (ValueError, LookupError) as error:
        if isinstance(error, WeightsError):
            raise
        raise WeightsError(f"its pickle is damaged or cut short ({first_line(error)})") from None
