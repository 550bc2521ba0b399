"""Labels, descriptions and COCO files of any content are read, or refused with a reason."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from yolov5_lifecycle.evaluation.coco_file import read_coco_file
from yolov5_lifecycle.evaluation.ground_truth import DataError, Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_description
from yolov5_lifecycle.evaluation.yolo_labels import parsed_labels

FIELDS = st.one_of(
    st.sampled_from(["0", "1", "-1", "0.5", "1.0", "nan", "1e999", "0x1", "\ufeff0", "٣", "0_1"]),
    st.floats().map(str),
    st.text(max_size=5),
)
SCALARS = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8))
VALUES = st.recursive(
    SCALARS,
    lambda below: st.lists(below, max_size=5) | st.dictionaries(st.text(max_size=4), below, max_size=4),
    max_leaves=10,
)
NUMBERS = st.one_of(st.integers(0, 3), VALUES)


def records(**fields: st.SearchStrategy[Any]) -> st.SearchStrategy[list[Any]]:
    return st.lists(st.one_of(st.fixed_dictionaries(fields), VALUES), max_size=6)


COCO = st.fixed_dictionaries(
    {
        "images": records(id=NUMBERS, file_name=st.just("1.jpg") | VALUES, height=NUMBERS, width=NUMBERS),
        "annotations": records(
            image_id=NUMBERS, category_id=NUMBERS, bbox=st.lists(NUMBERS, max_size=5) | VALUES, iscrowd=VALUES
        ),
        "categories": records(id=NUMBERS, name=st.sampled_from(["cat", "dog"]) | VALUES),
    }
)


@given(st.lists(st.lists(FIELDS, max_size=9).map(" ".join), max_size=4).map("\n".join))
def test_labels_are_boxes_in_the_image_or_refused(text: str) -> None:
    try:
        boxes = parsed_labels(text, 2).in_pixels((100, 200))
    except DataError as error:
        refused = str(error)
    else:
        refused = ""
        assert np.isfinite(boxes.xyxy).all()
        assert (boxes.xyxy[:, :2] < boxes.xyxy[:, 2:]).all()
        assert (boxes.xyxy >= 0).all()
        assert (boxes.xyxy <= (200, 100, 200, 100)).all()
        assert set(boxes.class_ids.tolist()) <= {0, 1}
    assert not refused or refused.startswith("line ")
    assert len(refused) < 200


@pytest.mark.long
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(content=COCO)
def test_a_coco_file_has_boxes_of_known_classes_or_is_refused(content: object, tmp_path: Path) -> None:
    path = tmp_path / "truth.json"
    path.write_text(json.dumps(content))
    (tmp_path / "1.jpg").touch()
    told: list[str] = []
    try:
        folder = read_coco_file(path, Problems(told.append), root=tmp_path)
    except DataError as error:
        refused = str(error)
    else:
        refused = ""
        assert folder.class_names is not None
        for image in folder.images:
            boxes = image.labels.boxes
            assert (boxes.xyxy[:, :2] < boxes.xyxy[:, 2:]).all()
            assert boxes.class_ids.max(initial=0) < len(folder.class_names)
    assert not refused or refused.startswith(f"{path}: ")
    assert all(text.isprintable() for text in told)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(text=st.one_of(st.text(max_size=60), VALUES.map(json.dumps), st.binary(max_size=40)))
def test_a_description_has_names_and_paths_or_is_refused(text: str | bytes, tmp_path: Path) -> None:
    path = tmp_path / "data.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "replace"))
    try:
        description = read_description(path)
    except DataError as error:
        refused = str(error)
    else:
        refused = ""
        names = description.class_names
        assert names is None or all(names)
        assert all(map(all, description.splits.values()))
    assert not refused or refused.startswith(f"{path}: ")


@pytest.mark.parametrize("depth", [900, 20_000])
def test_json_nested_in_a_record_is_refused_or_read_by_its_surface(depth: int, tmp_path: Path) -> None:
    nested = "[" * depth + "]" * depth
    path = tmp_path / "truth.json"
    path.write_text(f'{{"images": [{nested}], "annotations": [{nested}], "categories": [{nested}]}}')
    with pytest.raises(DataError):
        read_coco_file(path, Problems(lambda _: None), root=tmp_path)
