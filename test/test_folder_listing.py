"""Folders with many files are listed up to a limit."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from yolov5_lifecycle import folder_listing
from yolov5_lifecycle.folder_listing import FolderTree, entries
from yolov5_lifecycle.offline.recordings import is_recording
from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.sources.source import image_paths

LIMIT = 5


@pytest.fixture(autouse=True)
def low_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder_listing, "MAX_ENTRIES", LIMIT)


def filled(folder: Path, count: int) -> Path:
    folder.mkdir(exist_ok=True)
    for number in range(count):
        (folder / f"{number}.jpg").touch()
    return folder


def test_a_folder_is_listed_up_to_the_limit(tmp_path: Path) -> None:
    assert len(list(entries(filled(tmp_path, LIMIT)))) == LIMIT
    assert len(list(FolderTree().files(tmp_path))) == LIMIT
    with pytest.raises(OSError, match="expected at most 5 files and folders, found more"):
        list(entries(filled(tmp_path, LIMIT + 1)))


def test_a_folder_is_read_no_further_than_its_files_are_asked_for(tmp_path: Path) -> None:
    files = FolderTree().files(filled(tmp_path, LIMIT + 1))
    assert len({next(files) for _ in range(LIMIT)}) == LIMIT
    with pytest.raises(OSError, match="found more"):
        next(files)


def test_folders_below_count_together_however_often_they_are_listed(tmp_path: Path) -> None:
    filled(tmp_path, 1)
    filled(tmp_path / "below", 1)  # 3 entries: two files and a folder
    tree = FolderTree()
    assert sorted(path.name for path in tree.files(tmp_path)) == ["0.jpg", "0.jpg"]
    with pytest.raises(OSError, match="found more"):
        list(tree.files(tmp_path))


def test_a_folder_below_that_cannot_be_listed_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One with a path that is too long, as root may list all others."""
    monkeypatch.setattr(folder_listing, "MAX_ENTRIES", 100)
    name = "x" * 250
    outer = os.open(tmp_path, os.O_RDONLY)
    for _ in range(4096 // len(name) + 1):
        os.mkdir(name, dir_fd=outer)
        inner = os.open(name, os.O_RDONLY, dir_fd=outer)
        os.close(outer)
        outer = inner
    os.close(outer)
    with pytest.raises(OSError, match=r"cannot be listed \(File name too long\)"):
        list(FolderTree().files(tmp_path))


def test_links_to_folders_are_not_followed(tmp_path: Path) -> None:
    (filled(tmp_path / "below", 1) / "loop").symlink_to(tmp_path)
    assert [path.name for path in FolderTree().files(tmp_path) if not path.is_dir()] == ["0.jpg"]


def test_a_folder_of_too_many_images_is_no_source(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="expected at most 5 files"):
        image_paths(filled(tmp_path, LIMIT + 1))


def test_a_folder_of_too_many_files_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="found more"):
        is_recording(filled(tmp_path, LIMIT + 1))
