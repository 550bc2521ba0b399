"""Rules for the values of single settings beyond type and limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence

from pydantic_core import PydanticCustomError

from yolov5_lifecycle.images.region import Region
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.camera_overrides import camera_names_rule
from yolov5_lifecycle.settings.schema import violation
from yolov5_lifecycle.settings.suggestion import did_you_mean

Rule = Callable[..., object]
"""The value as it is stored; raises the error of `violation` for a wrong one."""

MAX_CLASS_NAME = 200
"""Characters; no model has longer names."""
_MAX_SHOWN = 60


def digest(value: str) -> str:
    """A SHA-256 or nothing, in lower case."""
    if value and (len(value) != 64 or set(value.lower()) - set("0123456789abcdef")):
        raise violation("must be 64 hexadecimal digits or empty.")
    return value.lower()


def folders(value: tuple[str, ...]) -> tuple[str, ...]:
    """Folders that do not depend on where the process was started."""
    if not all(folder.startswith(("/", "~", "package://")) for folder in value):
        raise violation("must be absolute paths, or begin with ~ or package://.")
    return value


def folder(value: str) -> str:
    """A folder that does not depend on where the process was started, or nothing."""
    if value and not value.startswith(("/", "~")):
        raise violation("must be an absolute path, or begin with ~.")
    return value


def device(value: str) -> str:
    """A device by its full name."""
    kind, _, index = value.partition(":")
    is_index = index.isascii() and index.isdigit() and len(index) <= 3
    if value in ("auto", "cpu", "cuda", "mps") or (kind == "cuda" and is_index):
        return value
    if value.isascii() and value.isdigit() and len(value) <= 3:
        return f"cuda:{value}"
    hint = (
        " Did you mean 'cuda'?"
        if value.lower() == "gpu"
        else did_you_mean(value, ("auto", "cpu", "cuda", "mps"))
    )
    raise violation(f"must be auto, cpu, cuda, cuda:N, N or mps.{hint}")


def classes(value: tuple[str, ...]) -> tuple[str, ...]:
    """Names or indices of classes."""
    if any(len(name) > MAX_CLASS_NAME for name in value):
        raise violation(f"must be names or indices of at most {MAX_CLASS_NAME} characters.")
    return value


def class_threshold(entry: str) -> tuple[str, float]:
    """The name or index of a class and its threshold, from 0 to 1, of an entry such as "person: 0.5".

    The last colon separates them: the name of a class may have some.
    """
    name, colon, text = (part.strip() for part in entry.rpartition(":"))
    if len(name) > MAX_CLASS_NAME:
        raise _no_threshold(entry, f"names a class with more than {MAX_CLASS_NAME} characters")
    try:
        threshold = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        threshold = math.nan
    if not (name and colon and 0 <= threshold <= 1):
        raise _no_threshold(
            entry, "is not a class name or index, a colon and a number from 0 to 1, as in 'person: 0.5'"
        )
    return name, threshold


def thresholds_of_classes(value: tuple[str, ...]) -> tuple[str, ...]:
    """Entries such as "person: 0.5", one per class."""
    found = set[str]()
    for name, _ in map(class_threshold, value):
        if name in found:
            raise _no_threshold(name, "has more than one threshold")
        found.add(name)
    return value


def _no_threshold(entry: str, problem: str) -> PydanticCustomError:
    return violation(f"are not class thresholds: '{in_one_line(entry, _MAX_SHOWN)}' {problem}.")


COLLECT_REASONS = ("uncertain", "unusual", "novel")
"""What `collect_reasons` may have besides classes."""
_CLASS = "class:"


def classes_of_reasons(reasons: Sequence[str]) -> tuple[str, ...]:
    """The names or indices in entries of `collect_reasons` such as "class: person"."""
    return tuple(entry.removeprefix(_CLASS).strip() for entry in reasons if entry.startswith(_CLASS))


def collect_reasons(value: tuple[str, ...]) -> tuple[str, ...]:
    """Entries of COLLECT_REASONS, and classes."""
    classes(classes_of_reasons(value))
    for entry in value:
        if entry not in COLLECT_REASONS and not (entry.startswith(_CLASS) and entry[len(_CLASS) :].strip()):
            known = ", ".join(COLLECT_REASONS)
            hint = did_you_mean(entry, COLLECT_REASONS)
            raise violation(f"must be {known} or classes, as in 'class: person'.{hint}")
    return value


def regions(value: tuple[str, ...]) -> tuple[str, ...]:
    """Polygons such as "0.1,0.5 0.9,0.5 0.5,1"."""
    for number, text in enumerate(value, 1):
        if problem := _region_problem(text):
            raise violation(f"must be polygons, but entry {number} {problem}.")
    return value


def _region_problem(text: str) -> str:
    try:
        Region.parse(text)
    except ValueError as error:
        return str(error)
    return ""


def frame(value: str) -> str:
    """Name of a frame of tf2."""
    if value.startswith("/") or not value.isprintable() or value != value.strip():
        raise violation("must be the name of a frame without a leading slash, such as base_link.")
    return value


def cameras(value: tuple[str, ...], settings: Collection[str]) -> tuple[str, ...]:
    """Names of cameras; `settings` are the names of the settings."""
    if rule := camera_names_rule(value, settings):
        raise violation(rule)
    return value


RULES: Mapping[str, Rule] = {
    "weights_sha256": digest,
    "weights_dirs": folders,
    "device": device,
    "classes": classes,
    "points_classes": classes,
    "target_frame": frame,
    "class_thresholds": thresholds_of_classes,
    "regions": regions,
    "ignore_regions": regions,
    "collect_blank_regions": regions,
    "collect_reasons": collect_reasons,
    "collect_dir": folder,
}
"""By the name of the setting."""
