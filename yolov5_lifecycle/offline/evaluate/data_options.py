"""Options that say how a labelled data set is read."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.evaluation.data_description import SPLITS


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """How to read a data set: see `add_data_options`; `truth_topic` is the topic of corrected detections."""

    split: str | None = None
    root: Path | None = None
    topic: str | None = None
    truth_topic: str | None = None

    def useless(self, kind: str) -> list[str]:
        """The given options that do not apply to data sets of this `kind`."""
        of_kind = {"YOLO": ("split", "root"), "COCO": ("root",), "recording": ("topic", "truth_topic")}[kind]
        return [name for name, value in vars(self).items() if value is not None and name not in of_kind]


def add_data_options(parser: argparse.ArgumentParser) -> None:
    """Add the options split, root and topic."""
    parser.add_argument(
        "--split",
        choices=SPLITS,
        help=f"images of data.yaml to use (default: the first of {', '.join(SPLITS)})",
    )
    parser.add_argument(
        "--root",
        type=Path,
        metavar="FOLDER",
        help="folder of the labelled images; nothing outside it is read (default: that of data.yaml or JSON)",
    )
    parser.add_argument("--topic", help="image topic of a recording (default: the only one)")
