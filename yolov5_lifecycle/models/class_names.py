"""Names of classes as text that is safe to show, whatever kinds of values a file has as names.

A name without unprintable characters is never changed.
"""

from __future__ import annotations

from yolov5_lifecycle.printable import escaped

MAX_NAME_LENGTH = 200
"""Characters."""
_MAX_DIGITS = 9
_MAX_SHOWN = 60
_HUGE = 10**50
"""Larger integers take ever longer to write."""


class ClassNamesError(ValueError):
    """Class names that cannot be used; the message lacks a remedy, which depends on the file."""


def class_names_of(names: object, least: int, most: int) -> tuple[str, ...]:
    """The names of `least` to `most` classes, by index, from a list or from a dict by index.

    Numbers and truth values become text, blanks of every kind become spaces, and unprintable characters
    become escapes such as `\\x1b`. A class without a name is called "class 3", say, by its index. Equal names
    stay equal.

    Raises ClassNamesError.
    """
    found = _by_index(names, least, most) if isinstance(names, dict) else names
    if not isinstance(found, (list, tuple)) or not least <= len(found) <= most:
        told = f"{len(found)} names" if isinstance(found, (list, tuple)) else _shown(found)
        raise ClassNamesError(f"expected names of {_range(least, most)} classes, found {told}")
    return tuple(_text(name) or f"class {index}" for index, name in enumerate(found))


def safe_name(name: str) -> str:
    """A name with spaces for blanks of every kind, and escapes for unprintable characters.

    Raises ClassNamesError if it has more than `MAX_NAME_LENGTH` characters.
    """
    _check_length(name)  # before the work that grows with it
    safe = escaped(" ".join(name.split()))
    _check_length(safe)
    return safe


def _check_length(name: str) -> None:
    if len(name) > MAX_NAME_LENGTH:
        raise ClassNamesError(f"found a class name of {len(name)} characters, more than {MAX_NAME_LENGTH}")


def _by_index(names: dict[object, object], least: int, most: int) -> list[object]:
    """The names in the order of their indices, None for an index that has none."""
    indices = {_index(key, most): name for key, name in names.items()}
    if len(indices) < len(names):
        raise ClassNamesError("expected a name for each class, found two with the same index")
    return [indices.get(index) for index in range(max(least, *(index + 1 for index in indices), 0))]


def _index(key: object, classes: int) -> int:
    """An index, which may be written as text: JSON has no other keys."""
    if isinstance(key, str) and key.isascii() and key.isdigit() and len(key) <= _MAX_DIGITS:
        key = int(key)
    if isinstance(key, bool) or not isinstance(key, int) or not 0 <= key < classes:
        raise ClassNamesError(f"expected class names numbered from 0 to {classes - 1}, found {_shown(key)}")
    return key


def _text(name: object) -> str:
    """The name as safe text; "" if there is none."""
    if name is None:
        return ""
    if isinstance(name, float) or (isinstance(name, int) and abs(name) < _HUGE):
        return str(name)
    if not isinstance(name, str):
        raise ClassNamesError(f"expected class names that are strings or numbers, found {_shown(name)}")
    return safe_name(name)


def _range(least: int, most: int) -> str:
    return str(most) if least == most else f"{least} to {most}"


def _shown(value: object) -> str:
    """A short text of any value, such as 'cat' or "a list"."""
    if value is None or isinstance(value, float):
        return str(value)
    if isinstance(value, str):
        return repr(value[:_MAX_SHOWN])
    if isinstance(value, int):
        return str(value) if abs(value) < _HUGE else "a huge number"
    return f"a {type(value).__name__[:_MAX_SHOWN]}"
