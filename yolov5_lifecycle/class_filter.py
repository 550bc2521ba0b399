"""Which classes of a model a list of names or indices selects."""

from __future__ import annotations

from collections.abc import Sequence

from yolov5_lifecycle.suggestion import did_you_mean


class ClassFilterError(ValueError):
    """An entry of the filter is no class of the model."""


def class_ids(entries: Sequence[str], class_names: Sequence[str]) -> frozenset[int] | None:
    """Indices into `class_names` of the selected classes; None, meaning all, for an empty filter.

    An entry is a class name or a decimal index; a name wins over an index that looks like it.

    Raises ClassFilterError naming every entry that the model does not have.
    """
    if not entries:
        return None
    unknown = [entry for entry in entries if not _ids(entry, class_names)]
    if unknown:
        raise ClassFilterError(" ".join(_explain(entry, class_names) for entry in unknown))
    return frozenset(class_id for entry in entries for class_id in _ids(entry, class_names))


def _ids(entry: str, class_names: Sequence[str]) -> list[int]:
    named = [class_id for class_id, name in enumerate(class_names) if name == entry]
    if not named and entry.isascii() and entry.isdigit() and int(entry) < len(class_names):
        return [int(entry)]
    return named


def _explain(entry: str, class_names: Sequence[str]) -> str:
    count = len(class_names)
    if entry.isascii() and entry.isdigit():
        return f"Class index {entry} is out of range: the model has {count} classes, 0 to {count - 1}."
    shown = ", ".join(class_names[:8]) + (", ..." if count > 8 else "")
    return f"'{entry}' is not a class of the model ({shown}).{did_you_mean(entry, class_names)}"
