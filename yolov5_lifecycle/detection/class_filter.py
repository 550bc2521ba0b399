"""Class names or indices in settings -> class ids of a model, and the `Selection` that settings make."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.region import BoxFilter, Region
from yolov5_lifecycle.models.class_names import ClassNamesError, safe_name
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.schema import SEPARATOR, Problem
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.settings.suggestion import did_you_mean
from yolov5_lifecycle.settings.value_rules import class_threshold, classes_of_reasons

MAX_EXPLAINED = 3
"""Number of unknown entries that are explained; the rest are only counted."""
_SHOWN_CLASSES = 8
_MAX_SHOWN = 60


def model_problems(settings: Settings, class_names: tuple[str, ...]) -> list[Problem]:
    """Problems of `settings` and of the overrides for cameras with a loaded model that has `class_names`."""
    problems = []
    of_cameras = {f"{camera}{SEPARATOR}": settings.for_camera(camera) for camera in settings.camera_names}
    for prefix, own in {"": settings, **of_cameras}.items():
        for name, resolve in _MODEL_DEPENDENT.items():
            entries = getattr(own, name)
            if prefix and entries == getattr(settings, name):
                continue
            try:
                resolve(entries, class_names)
            except ValueError as error:
                problems.append(Problem(prefix + name, str(error)))
    return problems


def selection_of(settings: Settings, class_names: tuple[str, ...]) -> Selection:
    """NMS and filter parameters from `settings`; ValueError when `model_problems` reports any."""
    return Selection(
        confidence_threshold=settings.confidence_threshold,
        class_thresholds=class_thresholds(settings.class_thresholds, class_names),
        iou_threshold=settings.iou_threshold,
        max_detections=settings.max_detections,
        classes=class_ids(settings.classes, class_names),
        agnostic_nms=settings.agnostic_nms,
        box_filter=_box_filter(settings),
    )


def _box_filter(settings: Settings) -> BoxFilter | None:
    """Which boxes count; None if all do."""
    filters = (settings.regions, settings.ignore_regions, settings.min_box_size, settings.max_box_size)
    if not any(filters):
        return None
    return BoxFilter(
        regions=tuple(map(Region.parse, settings.regions)),
        ignore_regions=tuple(map(Region.parse, settings.ignore_regions)),
        region_anchor=settings.region_anchor,
        min_box_size=settings.min_box_size,
        max_box_size=settings.max_box_size,
    )


def class_ids(entries: Sequence[str], class_names: Sequence[str]) -> frozenset[int] | None:
    """Class ids (indices into `class_names`) that `entries` select; None (all classes) for an empty filter.

    An entry is a class name or a decimal index; a class name takes precedence over an equal index.

    Raises ValueError naming the first entries that are not classes of the model.
    """
    if not entries:
        return None
    found = _ids_by_entry(entries, class_names)
    return frozenset(class_id for ids in found.values() for class_id in ids)


def class_thresholds(entries: Sequence[str], class_names: Sequence[str]) -> tuple[tuple[int, float], ...]:
    """Class ids and their thresholds from `entries` such as "person: 0.5".

    Raises ValueError naming the first that are not classes of the model, or a class with two.
    """
    if not entries:
        return ()
    thresholds = dict(map(class_threshold, entries))
    names_by_id: dict[int, str] = {}
    for name, ids in _ids_by_entry(list(thresholds), class_names).items():
        for class_id in ids:
            if (other := names_by_id.setdefault(class_id, name)) != name:
                raise ValueError(f"'{_shown(other)}' and '{_shown(name)}' are the same class.")
    return tuple((class_id, thresholds[name]) for class_id, name in sorted(names_by_id.items()))


def _ids_by_entry(entries: Sequence[str], class_names: Sequence[str]) -> dict[str, list[int]]:
    """The class ids of each of `entries`, names or indices; raises ValueError."""
    ids_by_index = {str(class_id): [class_id] for class_id in range(len(class_names))}
    ids_by_name: defaultdict[str, list[int]] = defaultdict(list)
    for class_id, name in enumerate(class_names):
        ids_by_name[name].append(class_id)
    found = {
        entry: ids_by_name.get(entry)
        or ids_by_name.get(_safe(entry))
        or ids_by_index.get(entry and (entry.lstrip("0") or "0"), [])
        for entry in entries
    }
    if unknown := [entry for entry, ids in found.items() if not ids]:
        raise ValueError(_explanation(unknown, class_names))
    return found


def _safe(entry: str) -> str:
    """The class name that the model has if the file has `entry`; "" if no class can have it."""
    try:
        return safe_name(entry)
    except ClassNamesError:
        return ""


_MODEL_DEPENDENT: Mapping[str, Callable[[Sequence[str], Sequence[str]], object]] = {
    "classes": class_ids,
    "class_thresholds": class_thresholds,
    "points_classes": class_ids,
    "collect_reasons": lambda reasons, names: class_ids(classes_of_reasons(reasons), names),
}
"""By setting: the function that resolves it with the class names, or raises ValueError."""


def _explanation(unknown: Sequence[str], class_names: Sequence[str]) -> str:
    explained = [_explain(entry, class_names) for entry in unknown[:MAX_EXPLAINED]]
    if (rest := len(unknown) - MAX_EXPLAINED) > 0:
        explained.append(f"{rest} more entries are not classes of the model either.")
    return " ".join(explained)


def _explain(entry: str, class_names: Sequence[str]) -> str:
    count = len(class_names)
    if entry.isascii() and entry.isdigit():
        return (
            f"Class index {_shown(entry)} is out of range: the model has {count} classes, 0 to {count - 1}."
        )
    shown = ", ".join(map(_shown, class_names[:_SHOWN_CLASSES])) + (", ..." if count > _SHOWN_CLASSES else "")
    return f"'{_shown(entry)}' is not a class of the model ({shown}).{did_you_mean(entry, class_names)}"


def _shown(text: str) -> str:
    return in_one_line(text, _MAX_SHOWN)
