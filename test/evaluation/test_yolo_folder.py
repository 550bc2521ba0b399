"""Folders in YOLO format: what belongs to the data set, and that nothing outside of it is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from yolov5_lifecycle.evaluation.ground_truth import DataError, LabelledFolder, Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_yolo_folder

BOX = "0 0.5 0.5 0.2 0.2\n"
NAMES = "names: [cat, dog]\n"
SPLIT = "images/val/1 images/train/2"
BOTH = "images/train/2.jpg images/val/1.jpg"


def data_set(folder: Path, description: str | None, *labelled: str) -> Path:
    """A data set with images, which nobody opens here, and labels at the paths `labelled`."""
    folder.mkdir(exist_ok=True)
    if description is not None:
        (folder / "data.yaml").write_text(description)
    for name in labelled:
        for path, text in ((folder / f"{name}.jpg", ""), (folder / _label_name(name), BOX)):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    return folder


def _label_name(name: str) -> str:
    head, images, tail = name.rpartition("images/")
    return f"{head}labels/{tail}.txt" if images else f"{name}.txt"


class Told:
    """Reads a data set and keeps the reported problems."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.problems = Problems(self.lines.append)

    def read(self, data: Path, split: str | None = None, root: Path | None = None) -> LabelledFolder:
        return read_yolo_folder(data, self.problems, split=split, root=root)

    def names(self, data: Path, split: str | None = None) -> list[str]:
        """The images relative to `data`, all with one box, sorted."""
        images = self.read(data, split).images
        assert all(len(image.labels.boxes) == 1 for image in images)
        folder = data if data.is_dir() else data.parent
        return sorted(str(image.path.relative_to(folder)) for image in images)


@pytest.mark.parametrize(
    ("description", "labelled", "found"),
    [
        pytest.param(None, "images/1 images/a/2", "images/1.jpg images/a/2.jpg", id="no yaml"),
        pytest.param("", "images/1", "images/1.jpg", id="no entries"),
        pytest.param(None, "1 a/2", "1.jpg a/2.jpg", id="no yaml, labels beside images"),
        pytest.param("val: images/val\ntrain: images/train\n", SPLIT, "images/val/1.jpg", id="val"),
        pytest.param("train: images/train\nval:\n", SPLIT, "images/train/2.jpg", id="val empty"),
        pytest.param("path: ~\ntrain: images/train\nval: null\n", SPLIT, "images/train/2.jpg", id="val null"),
        pytest.param("val: [images/val, images/train]\n", SPLIT, BOTH, id="several"),
        pytest.param("path: below\nval: images\n", "below/images/1", "below/images/1.jpg", id="path"),
        pytest.param("path: /elsewhere\nval: images\n", "images/1", "images/1.jpg", id="path elsewhere"),
        pytest.param(
            "val: ../valid/images\n", "valid/images/1", "valid/images/1.jpg", id="as Roboflow writes"
        ),
        pytest.param("val: shots\n", "shots/1", "shots/1.jpg", id="labels beside images"),
        pytest.param("val: images/1.jpg\n", "images/1 images/2", "images/1.jpg", id="one image"),
        pytest.param(
            "val: images\nroboflow:\n  a: {b: [c, 1]}\ndownload: |\n  code\n",
            "images/1",
            "images/1.jpg",
            id="more entries",
        ),
    ],
)
def test_the_images_are_those_of_the_entry(
    description: str | None, labelled: str, found: str, tmp_path: Path
) -> None:
    text = None if description is None else description + NAMES
    data = data_set(tmp_path / "data", text, *labelled.split())
    for given in (data, data / "data.yaml") if text else (data,):
        assert Told().names(given) == found.split()


def test_the_split_chooses_the_entry(tmp_path: Path) -> None:
    text = f"val: images/val\ntrain: images/train\n{NAMES}"
    data = data_set(tmp_path / "data", text, *SPLIT.split())
    assert Told().names(data, "train") == ["images/train/2.jpg"]
    with pytest.raises(DataError, match=r"there is no entry 'test', only: val, train\."):
        Told().read(data, "test")


@pytest.mark.parametrize(
    ("given", "found"),
    [
        pytest.param("images", ["train/1.jpg", "val/2.jpg"], id="images"),
        pytest.param("images/val", ["2.jpg"], id="images of one kind"),
    ],
)
def test_a_folder_of_images_has_its_labels_where_yolov5_looks_for_them(
    given: str, found: list[str], tmp_path: Path
) -> None:
    data = data_set(tmp_path / "data", None, "images/train/1", "images/val/2")
    assert Told().names(data / given) == found


def test_labels_lie_beside_images_also_below_another_folder_called_images(tmp_path: Path) -> None:
    data = data_set(tmp_path, None, "images/shots/1")
    (data / "labels" / "shots" / "1.txt").rename(data / "images" / "shots" / "1.txt")
    assert Told().names(data / "images" / "shots") == ["1.jpg"]


def test_a_list_names_images_relative_to_itself(tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", f"val: val.txt\n{NAMES}", "images/1", "images/2", "images/3")
    (data / "val.txt").write_text(
        "./images/1.jpg\n\nimages/3.jpg\n../secret.jpg\n/etc/passwd\nimages/1.jpg\n"
    )
    told = Told()
    assert told.names(data) == ["images/1.jpg", "images/3.jpg"]
    assert told.problems.counts == {"unusable entries": 2}
    assert "'../secret.jpg' lies outside of" in told.lines[0]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_list_and_a_description_may_have_a_byte_order_mark(encoding: str, tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", None, "images/1")
    (data / "data.yaml").write_text(f"val: val.txt\n{NAMES}", encoding=encoding)
    (data / "val.txt").write_text("images/1.jpg\n", encoding=encoding)
    told = Told()
    assert (told.names(data), told.lines) == (["images/1.jpg"], [])


@pytest.mark.parametrize(
    ("line", "told"),
    [
        pytest.param(r"images\1.jpg", r"a path of Windows; type sed -i 's|\\|/|g' FILE", id="backslash"),
        pytest.param("C:/a/images/1.jpg", "a path of Windows; make it relative to ", id="drive"),
        pytest.param(r"C:\a\1.jpg", r"sed -i 's|\\|/|g' FILE; make it relative to ", id="both"),
        pytest.param("../there.jpg", "; --root names the folder that may be read", id="outside"),
    ],
)
def test_a_line_of_a_list_that_names_nothing_here_says_what_helps(
    line: str, told: str, tmp_path: Path
) -> None:
    data = data_set(tmp_path / "data", f"val: [val.txt, images]\n{NAMES}", "images/1", "../there")
    (data / "val.txt").write_text(f"{line}\n")
    reader = Told()
    assert reader.names(data) == ["images/1.jpg"]
    assert told in reader.lines[0]


@pytest.mark.parametrize("line", ["../missing.jpg", "/home/them/images/1.jpg"])
def test_the_root_is_not_advised_for_a_file_that_does_not_exist(line: str, tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", f"val: [val.txt, images]\n{NAMES}", "images/1")
    (data / "val.txt").write_text(f"{line}\n")
    reader = Told()
    reader.read(data)
    assert "lies outside of" in reader.lines[0]
    assert "--root" not in reader.lines[0]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        pytest.param("names: [cat, dog]", ("cat", "dog"), id="list"),
        pytest.param("names:\n- cat\n- dog", ("cat", "dog"), id="lines"),
        pytest.param("names: {0: cat, 1: dog}", ("cat", "dog"), id="mapping"),
        pytest.param("names: {1: dog, 0: cat}", ("cat", "dog"), id="mapping in disorder"),
        pytest.param("names: [no, 1]", ("False", "1"), id="words of YAML"),
        pytest.param("names: ['no', \"1\"]", ("no", "1"), id="words in quotes"),
        pytest.param("names: [0x10, 1_0, .5, 0b_]", ("16", "10", "0.5", "0b_"), id="numbers of YAML"),
        pytest.param("names: [~, '', cat]", ("class 0", "class 1", "cat"), id="no name"),
        pytest.param("names: [2024-01-02, = ]", ("2024-01-02", "="), id="what is neither text nor number"),
        pytest.param("names: {0: cat, 2: dog}", ("cat", "class 1", "dog"), id="gap"),
        pytest.param("names: [1, '1']", ("1 (class 0)", "1"), id="number and text"),
        pytest.param('names: ["a\\tb", "\\e[31m"]', ("a b", r"\x1b[31m"), id="unprintable"),
        pytest.param("nc: 2", None, id="none"),
    ],
)
def test_class_names(names: str, expected: tuple[str, ...] | None, tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", f"val: images\n{names}\n", "images/1")
    assert Told().read(data).class_names == expected


def test_what_is_broken_is_listed_and_the_rest_is_read(tmp_path: Path) -> None:
    data = data_set(
        tmp_path / "data", f"val: images\n{NAMES}", *(f"images/{number:02}" for number in range(20))
    )
    for number in range(15):
        (data / "labels" / f"{number:02}.txt").write_text("7 0.5 0.5 0.2 0.2\n")
    (data / "labels" / "19.txt").unlink()
    told = Told()
    images = told.read(data).images
    assert [image.path.stem for image in images] == ["15", "16", "17", "18", "19"]
    assert len(images[-1].labels.boxes) == 0, "an image without a label file shows nothing"
    assert told.problems.counts == {"broken labels": 15}
    assert len(told.lines) == 11
    assert told.lines[0].startswith("broken labels: ")
    assert "labels/00.txt: line 1: expected a class from 0 to 1, found 7" in told.lines[0]
    assert told.lines[-1] == "further problems are only counted"


def aliases(depth: int) -> str:
    """A YAML bomb."""
    lines = ["a0: &a0 [x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, depth)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("description", "reason"),
    [
        pytest.param(aliases(9), "an alias", id="bomb"),
        pytest.param("names: " + "[" * 5000, "nested more than 20 deep", id="deep"),
        pytest.param("x: " + "x" * (1 << 21), "1048576 bytes, the limit", id="large"),
        pytest.param("[1, 2]", "expected names and values", id="list"),
        pytest.param("just text", "expected names and values", id="text"),
        pytest.param("a: [", "line 2", id="broken"),
        pytest.param("names: {cat: 0}", "numbered from 0 to 9999, found 'cat'", id="no ids"),
        pytest.param("names: {0: cat, 10000: dog}", "numbered from 0 to 9999, found 10000", id="huge id"),
        pytest.param("names: [" + "x, " * 10_001 + "]", "of 0 to 10000 classes, found 10001", id="many"),
        pytest.param("names: cat", "must be a list", id="one name"),
        pytest.param("names: [[cat]]", "strings or numbers, found a list", id="nested names"),
        pytest.param("val: {a: b}", "must be paths", id="mapping as path"),
        pytest.param("val: ../../etc\nnames: [cat]", "there are no images", id="traversal"),
        pytest.param("val: /etc\nnames: [cat]", "there are no images", id="absolute"),
        pytest.param("val: missing\nnames: [cat]", "there are no images", id="missing"),
        pytest.param(f"val: {'x' * 300}\nnames: [cat]", "there are no images", id="long name"),
        pytest.param("", "none of 1 images has a label file", id="no labels"),
    ],
)
def test_a_data_set_of_which_nothing_can_be_used_is_refused(
    description: str, reason: str, tmp_path: Path
) -> None:
    data = data_set(tmp_path / "data", description)
    (data / "images").mkdir()
    (data / "images" / "1.jpg").touch()
    with pytest.raises(DataError) as refused:
        Told().read(data)
    assert reason in str(refused.value)
    assert len(str(refused.value)) < 1000


def test_a_folder_with_several_descriptions_asks_for_one(tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", None, "images/1")
    (data / "a.yaml").write_text(f"val: images\n{NAMES}")
    assert Told().read(data).class_names == ("cat", "dog")
    (data / "b.yml").touch()
    with pytest.raises(DataError, match=r"expected one data.yaml, found a.yaml, b.yml"):
        Told().read(data)


def test_the_root_widens_what_may_be_read(tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", f"val: ../images\n{NAMES}")
    data_set(tmp_path, None, "images/1")
    with pytest.raises(DataError, match="there are no images"):
        Told().read(data)
    (image,) = Told().read(data, root=tmp_path).images
    assert image.path == tmp_path / "images" / "1.jpg"
    assert len(image.labels.boxes) == 1
