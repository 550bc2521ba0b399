"""Detections as a table, a row for each, in CSV or Parquet."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from yolov5_lifecycle.offline.export.detected_image import DetectedImage, utf8

COLUMNS = {
    "width": "int32",
    "height": "int32",
    "class_id": "int32",
    "class_name": "string",
    "score": "float32",
    "x_min": "float32",
    "y_min": "float32",
    "x_max": "float32",
    "y_max": "float32",
    "id": "string",
}
"""Names and types of the columns behind those that identify the image; boxes in image pixels."""
_GROUP_ROWS = 1 << 16
"""Rows that are held in memory before they are written."""


def table_rows(found: DetectedImage, class_names: Sequence[str]) -> Iterator[tuple[object, ...]]:
    """The rows of an image in the order of its identity and COLUMNS; `id` is None without a track."""
    height, width = found.image.size_hw
    identity = tuple(map(utf8, found.named.identity.values()))
    detections = found.detections
    for one, class_id in zip(detections.objects(class_names), detections.class_ids.tolist(), strict=True):
        yield (
            *identity,
            *(width, height, class_id, one.class_name, one.score, *one.box_xyxy),
            one.track_id or None,
        )


class CsvTable:
    """Writes the new CSV file `path` with the names of the columns in its first line. See `Sink`."""

    def __init__(self, path: Path, class_names: Sequence[str], *, masks: bool) -> None:
        del masks  # a table has none
        self._class_names = class_names
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._has_header = False

    def add(self, found: DetectedImage) -> None:
        if not self._has_header:
            self._writer.writerow((*found.named.identity, *COLUMNS))
            self._has_header = True
        self._writer.writerows(table_rows(found, self._class_names))

    def finish(self) -> None:
        self.close()

    def close(self) -> None:
        self._file.close()


class ParquetTable:
    """Writes the new Parquet file `path`; needs pyarrow. See `Sink`."""

    def __init__(self, path: Path, class_names: Sequence[str], *, masks: bool) -> None:
        del masks  # a table has none
        self._class_names = class_names
        self._file = path.open("wb")
        self._schema: Any = None
        self._writer: Any = None
        self._rows: list[tuple[object, ...]] = []

    def add(self, found: DetectedImage) -> None:
        if self._writer is None:
            self._begin(found)
        self._rows.extend(table_rows(found, self._class_names))
        if len(self._rows) >= _GROUP_ROWS:
            self._write_rows()

    def finish(self) -> None:
        if self._writer is not None:
            self._write_rows()
        self.close()

    def close(self) -> None:
        writer, self._writer = self._writer, None
        try:
            if writer is not None:
                writer.close()
        finally:
            self._file.close()

    def _begin(self, found: DetectedImage) -> None:
        import pyarrow
        from pyarrow import parquet

        identity = found.named.identity
        kinds = ("string" if isinstance(value, str) else "int64" for value in identity.values())
        types = {**dict(zip(identity, kinds, strict=True)), **COLUMNS}
        self._schema = pyarrow.schema([(column, getattr(pyarrow, kind)()) for column, kind in types.items()])
        self._writer = parquet.ParquetWriter(self._file, self._schema)

    def _write_rows(self) -> None:
        import pyarrow

        columns = zip(*self._rows, strict=True) if self._rows else ((),) * len(self._schema)
        arrays = [
            pyarrow.array(column, field.type) for column, field in zip(columns, self._schema, strict=True)
        ]
        self._writer.write_table(pyarrow.table(arrays, schema=self._schema))
        self._rows.clear()
