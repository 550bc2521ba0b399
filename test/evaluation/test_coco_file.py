"""Files in COCO format: what is read, and that a hostile one is refused."""

from __future__ import annotations

import json
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from yolov5_lifecycle.evaluation import coco_file
from yolov5_lifecycle.evaluation.coco_file import read_coco_file
from yolov5_lifecycle.evaluation.ground_truth import DataError, LabelledFolder, Problems

CATEGORIES = [{"id": 7, "name": "cat"}, {"id": 90, "name": "dog"}]
BBOX = [10, 20, 30, 40.5]


def image(number: int, **changed: Any) -> dict[str, Any]:
    return {"id": number, "file_name": f"{number}.jpg", "height": 100, "width": 200, **changed}


def annotation(image_id: int, **changed: Any) -> dict[str, Any]:
    return {"id": 1, "image_id": image_id, "category_id": 90, "bbox": BBOX, **changed}


def write(folder: Path, content: object) -> Path:
    path = folder / "truth.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    (folder / "1.jpg").touch()
    return path


def coco(images: list[Any], annotations: list[Any], categories: list[Any] | None = None) -> dict[str, Any]:
    return {
        "images": images,
        "annotations": annotations,
        "categories": CATEGORIES if categories is None else categories,
    }


def read(path: Path, root: Path | None = None) -> tuple[LabelledFolder, list[str]]:
    lines: list[str] = []
    return read_coco_file(path, Problems(lines.append), root=root), lines


def test_images_boxes_and_classes_are_read(tmp_path: Path) -> None:
    crowd = annotation(1, category_id=7, iscrowd=1, bbox=[0, 0, 5, 5])
    found, problems = read(write(tmp_path, coco([image(1), image(2)], [annotation(1), crowd])))
    assert problems == []
    assert found.class_names == ("cat", "dog")
    assert [one.path.name for one in found.images] == ["1.jpg", "2.jpg"]
    boxes = found.images[0].in_pixels((100, 200))
    np.testing.assert_array_equal(boxes.xyxy, [(10, 20, 40, 60.5), (0, 0, 5, 5)])
    assert (boxes.class_ids.tolist(), boxes.is_crowd.tolist()) == ([1, 0], [False, True])
    with pytest.raises(DataError, match="for an image of 200 x 100 pixels, found 100 x 200"):
        found.images[0].in_pixels((200, 100))


@pytest.mark.parametrize("height", ["x", 10.5, -10, 10**30, True])
def test_a_height_that_no_image_has_is_not_compared(height: object, tmp_path: Path) -> None:
    found, _ = read(write(tmp_path, coco([image(1, height=height)], [annotation(1)])))
    assert found.images[0].size_hw is None


@pytest.mark.parametrize("bbox", [[20, 100, 5, 5], [-9, 20, 9, 5]], ids=["below", "left"])
def test_a_box_outside_of_an_image_of_unknown_size_is_refused(bbox: list[int], tmp_path: Path) -> None:
    unknown = {key: value for key, value in image(1).items() if key not in ("width", "height")}
    found, _ = read(write(tmp_path, coco([unknown], [annotation(1, bbox=bbox)])))
    with pytest.raises(DataError, match="a label is outside of its image of 200 x 100 pixels"):
        found.images[0].in_pixels((100, 200))


@pytest.mark.parametrize(
    ("json_name", "image_name"),
    [
        pytest.param("truth.json", "1.jpg", id="beside"),
        pytest.param("truth.json", "images/1.jpg", id="below"),
        pytest.param("annotations/truth.json", "1.jpg", id="above"),
        pytest.param("annotations/truth.json", "images/1.jpg", id="images beside the folder"),
        pytest.param("annotations/instances_val2017.json", "val2017/1.jpg", id="as COCO has it"),
    ],
)
def test_the_images_are_found_near_the_file(json_name: str, image_name: str, tmp_path: Path) -> None:
    for name in (json_name, image_name):
        (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / image_name).touch()
    (tmp_path / json_name).write_text(json.dumps(coco([image(1)], [annotation(1)])))
    found, _ = read(tmp_path / json_name)
    assert found.images[0].path == tmp_path / image_name


def test_the_root_says_where_the_images_are(tmp_path: Path) -> None:
    path = write(tmp_path, coco([image(1, file_name="a/1.jpg")], [annotation(1)]))
    found, _ = read(path, tmp_path / "elsewhere")
    assert found.images[0].path == tmp_path / "elsewhere" / "a" / "1.jpg"
    with pytest.raises(DataError, match="give their folder with --root"):
        read(path)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        pytest.param({"bbox": [1, 2, 3]}, "bbox.3: Field required, found a list", id="too short"),
        pytest.param(
            {"bbox": ["1", 2, 3, 4]}, "bbox.0: Input should be a valid number, found '1'", id="text"
        ),
        pytest.param(
            {"bbox": [1, 2, 0, 4]}, "bbox.2: Input should be greater than 0, found 0", id="no width"
        ),
        pytest.param({"bbox": [float("nan"), 2, 3, 4]}, "bbox.0: Input should be", id="NaN"),
        pytest.param({"bbox": [10**300, 2, 3, 4]}, "bbox.0: Input should be less than", id="huge"),
        pytest.param({"category_id": 1}, "the id of a category, found 1", id="unknown class"),
        pytest.param(
            {"category_id": [[]]}, "category_id: Input should be a valid integer, found a", id="list"
        ),
    ],
)
def test_an_image_with_a_broken_annotation_is_set_aside(
    changed: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    records = [annotation(1, **changed), annotation(2), annotation(1)]
    found, problems = read(write(tmp_path, coco([image(1), image(2)], records)))
    assert [one.path.name for one in found.images] == ["2.jpg"]
    assert len(problems) == 1
    assert problems[0].startswith("broken labels: annotation number 0: ")
    assert reason in problems[0]


@pytest.mark.parametrize(
    "record",
    [
        pytest.param(None, id="null"),
        pytest.param(image(1), id="id twice"),
        pytest.param(image(3, file_name="../3.jpg"), id="traversal"),
        pytest.param(image(3, file_name="a\0.jpg"), id="null character"),
        pytest.param(image(3, file_name="x" * 9000 + ".jpg"), id="long name"),
        pytest.param(image("3"), id="text as id"),  # type: ignore[arg-type]
    ],
)
def test_a_broken_image_record_is_listed_and_the_rest_is_read(record: object, tmp_path: Path) -> None:
    found, problems = read(write(tmp_path, coco([image(1), record], [annotation(1)])))
    assert len(found.images) == 1
    assert len(problems) == 1
    assert problems[0].startswith("unusable entries: ")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        pytest.param("[" * 100_000, "expected JSON", id="deep"),
        pytest.param('{"images": ' + "9" * 5000 + "}", "expected JSON", id="long number"),
        pytest.param("[]", "COCO's lists images, annotations, categories", id="list"),
        pytest.param({"images": [], "annotations": []}, "COCO's lists", id="no categories"),
        pytest.param({"images": {}, "annotations": [], "categories": []}, "COCO's lists", id="mapping"),
        pytest.param(coco([], []), r"no image that can be used\.$", id="no images"),
        pytest.param(coco([{"id": 1}], []), "can be used. 1 unusable entries", id="no name"),
        pytest.param(
            coco([image(1, file_name=r"val\1.jpg")], []),
            r"'val.1.jpg' is a path of Windows; type sed -i 's\|\\\\\\\\\|/\|g' FILE\.$",
            id="of Windows",
        ),
        pytest.param(coco([image(1, file_name="../outside.jpg")], []), r"lies outside of [^;]*$", id="above"),
        pytest.param(coco([image(1)], []), "no image has labels that can be used", id="no objects"),
        pytest.param(coco([], [], [{"id": 1, "name": "x" * 201}]), "a class name of 201", id="long name"),
        pytest.param(coco([], [], [{"id": 1, "name": []}]), "strings or numbers, found a list", id="list"),
    ],
)
def test_a_file_of_which_nothing_can_be_used_is_refused(content: object, reason: str, tmp_path: Path) -> None:
    (tmp_path.parent / "outside.jpg").touch()
    with pytest.raises(DataError, match=reason) as refused:
        read(write(tmp_path, content))
    assert str(refused.value).startswith(f"{tmp_path / 'truth.json'}: ")


def test_names_of_categories_are_those_that_a_model_has(tmp_path: Path) -> None:
    names = [7, "a\u00a0b", "\x1b", "", None]
    categories = [{"id": 10 + index, "name": name} for index, name in enumerate(names)]
    records = [annotation(1, category_id=12)]
    found, problems = read(write(tmp_path, coco([image(1)], records, categories)))
    assert found.class_names == ("7", "a b", r"\x1b", "class 3", "class 4")
    assert found.images[0].boxes.class_ids.tolist() == [2]
    assert problems == []


def test_numbers_that_python_takes_for_equal_are_no_ids(tmp_path: Path) -> None:
    images = [image(1), *(image(number << 61) for number in range(1, 4))]
    assert len(read(write(tmp_path, coco(images, [annotation(1)])))[0].images) == 1


def test_annotations_of_no_image_are_listed_and_the_rest_is_read(tmp_path: Path) -> None:
    of_a_list = annotation(1) | {"image_id": []}
    found, problems = read(write(tmp_path, coco([image(1)], [None, of_a_list, annotation(1)])))
    assert len(found.images) == 1
    assert [line.split(":")[1] for line in problems] == [" annotation number 0", " annotation number 1"]


def test_annotations_of_unknown_images_whose_ids_have_one_hash_are_passed_over(tmp_path: Path) -> None:
    records = [annotation(number * sys.hash_info.modulus) for number in range(2, 200_000)]
    path = write(tmp_path, coco([image(1)], [annotation(1), *records]))
    assert len(read(path)[0].images) == 1


@pytest.mark.parametrize(
    ("value", "count"),
    [
        pytest.param(lambda n: {str(n): n + 300}, 2_500, id="objects"),
        pytest.param(lambda n: [n + 300], 6_500, id="lists"),
        pytest.param(lambda n: n + 0.5, 20_000, id="numbers"),
        pytest.param(str, 9_000, id="texts"),
        pytest.param(lambda n: f"{n}\U0001f600" * 40, 700, id="wide texts"),
    ],
)
def test_the_memory_of_a_file_is_bounded_before_it_is_parsed(
    value: Callable[[int], object], count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coco_file, "MAX_PARSED_BYTES", 1_000_000)
    write(tmp_path, json.dumps([value(number) for number in range(count)], ensure_ascii=False))
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match="expected COCO's lists"):
            read(tmp_path / "truth.json")
        assert tracemalloc.get_traced_memory()[1] < 1_300_000
    finally:
        tracemalloc.stop()
    write(tmp_path, json.dumps([value(number) for number in range(2 * count)], ensure_ascii=False))
    with pytest.raises(DataError, match="at most 1,000,000 bytes of memory for its values"):
        read(tmp_path / "truth.json")


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coco_file, "MAX_BYTES", 50)
    with pytest.raises(DataError, match="more than 50 bytes"):
        read(write(tmp_path, "[" * 51))


@pytest.mark.parametrize(
    ("name", "key"), [("MAX_IMAGES", "images"), ("MAX_OBJECTS", "annotations"), ("MAX_CLASSES", "categories")]
)
def test_a_file_with_more_than_a_limit_is_refused(
    name: str, key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coco_file, name, 4)
    with pytest.raises(DataError, match=f"expected at most 4 {key}, found 5"):
        read(write(tmp_path, {**coco([], [], []), key: [1] * 5}))
