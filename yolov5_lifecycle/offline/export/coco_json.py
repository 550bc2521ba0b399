"""Detections as one COCO file: images, annotations with scores, and categories."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.offline.export.detected_image import DetectedImage

_ANNOTATIONS = ".annotations"


class CocoJson:
    """Writes the new file `path`, whatever the number of images: annotations wait in a file beside it.

    Ids of images and annotations begin with 1, because pycocotools takes 0 for none. See `Sink`.
    """

    def __init__(self, path: Path, class_names: Sequence[str], *, masks: bool) -> None:
        self._waiting = path.with_name(path.name + _ANNOTATIONS)
        self._masks = masks
        self._images = 0
        self._objects = 0
        categories = [{"id": number, "name": name} for number, name in enumerate(class_names)]
        self._file = path.open("w", encoding="utf-8")
        self._annotations = self._waiting.open("w+", encoding="utf-8")
        self._file.write(f'{{"categories": {json.dumps(categories)},\n"images": [')

    def add(self, found: DetectedImage) -> None:
        self._file.write(_separated(self._images, self._image(found)))
        self._images += 1
        for row in range(len(found.detections)):
            self._annotations.write(_separated(self._objects, self._annotation(found, row)))
            self._objects += 1

    def finish(self) -> None:
        self._file.write('],\n"annotations": [')
        self._annotations.seek(0)
        shutil.copyfileobj(self._annotations, self._file)
        self._file.write("]}\n")
        self.close()

    def close(self) -> None:
        self._annotations.close()
        self._waiting.unlink(missing_ok=True)
        self._file.close()

    def _image(self, found: DetectedImage) -> dict[str, object]:
        height, width = found.image.size_hw
        identity = dict(found.named.identity)
        file = identity.pop("file", None)
        name = found.named.stem if file is None else Path(str(file)).name
        return {"id": self._images + 1, "file_name": name, "width": width, "height": height, **identity}

    def _annotation(self, found: DetectedImage, row: int) -> dict[str, object]:
        x1, y1, x2, y2 = found.detections.boxes_xyxy[row].tolist()
        annotation: dict[str, object] = {
            "id": self._objects + 1,
            "image_id": self._images,
            "category_id": int(found.detections.class_ids[row]),
            "bbox": [x1, y1, x2 - x1, y2 - y1],
            "area": (x2 - x1) * (y2 - y1),
            "iscrowd": 0,
            "score": float(found.detections.scores[row]),
        }
        if self._masks and (mask := found.mask(row)) is not None:
            annotation["segmentation"], annotation["area"] = mask
        if found.detections.track_ids:
            annotation["track_id"] = found.detections.track_ids[row]
        return annotation


def _separated(before: int, record: dict[str, object]) -> str:
    """`record` for a list that already has `before` of them."""
    return f"{',' if before else ''}\n{json.dumps(record)}"
