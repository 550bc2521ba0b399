"""Class names and stride in the metadata of an ONNX export."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping

from yolov5_lifecycle.models.model import MAX_CLASSES, WeightsError, shown

_KEY = r"\d{1,6}"
_ESCAPE = r"\\(?:[\\'\"nrt]|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})"
_VALUE = rf"'(?:[^'\\\n]|{_ESCAPE})*'|\"(?:[^\"\\\n]|{_ESCAPE})*\"|-?\d{{1,18}}|True|False|None"
_ITEM = re.compile(rf"\s*(?:({_KEY})\s*:\s*)?({_VALUE})\s*(,|$)")


def exported_names(metadata: Mapping[str, str], classes: int) -> object:
    """The list or dict of class names; a list of None if the metadata has none, as before v6.2.

    Raises WeightsError if the entry is something else.
    """
    if "names" not in metadata:
        return [None] * classes
    entry = metadata["names"].strip()
    if len(entry) < 2 or entry[:1] + entry[-1:] not in ("{}", "[]"):
        raise WeightsError(f"expected a list or dict of class names as metadata, found {shown(entry)}")
    found: dict[int, object] = {}
    place, inside, is_dict = 0, entry[1:-1], entry.startswith("{")
    while place < len(inside):
        item = _ITEM.match(inside, place)
        if len(found) > MAX_CLASSES:
            raise WeightsError(f"the metadata has more than {MAX_CLASSES} class names")
        if item is None or (item[1] is not None) != is_dict:
            raise WeightsError(f"the class names in the metadata are damaged at {shown(inside[place:])}")
        found[int(item[1]) if is_dict else len(found)] = _literal(item[2])
        place = item.end()
    return found if is_dict else list(found.values())


def check_stride(metadata: Mapping[str, str], strides: tuple[int, ...]) -> None:
    """Raise WeightsError if the metadata has another largest stride than those of the boxes."""
    told = metadata.get("stride", str(max(strides)))
    if told not in (str(max(strides)), str(float(max(strides))), str(max(32, *strides))):
        raise WeightsError(f"the metadata has the stride {shown(told)}, the boxes have {max(strides)}")


def _literal(text: str) -> object:
    """The value of a single literal, which is no list and no dict."""
    try:
        return ast.literal_eval(text)
    except (SyntaxError, ValueError):
        raise WeightsError(f"the class names in the metadata are damaged at {shown(text)}") from None
