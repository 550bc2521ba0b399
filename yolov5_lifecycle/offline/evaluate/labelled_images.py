"""The images of a labelled data set, whatever it was read from."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from yolov5_lifecycle.evaluation.ground_truth import Labels
from yolov5_lifecycle.offline.detecting import StoredImage


class LabelledImage(StoredImage, Protocol):
    """A stored image with its ground truth and its number in the data set, from 0."""

    @property
    def number(self) -> int: ...

    @property
    def labels(self) -> Labels: ...


@dataclass(frozen=True)
class LabelledData:
    """An open data set.

    Each call of `images` starts over. `class_names` None: class ids are those of the model.
    """

    kind: str
    class_names: tuple[str, ...] | None
    expected: int
    images: Callable[[], Iterable[LabelledImage]]
