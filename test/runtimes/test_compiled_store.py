"""Compiled models are cached on disk for what they were compiled for; a damaged file counts as none."""

from __future__ import annotations

import dataclasses
import logging
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.random_model import TINY, random_model
from support.runtime_names import COMPILED_RUNTIMES

from yolov5_lifecycle.atomic_file import FOLDER_PREFIX, temporary_folder
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes import compiled_runtime
from yolov5_lifecycle.runtimes.cache import DiskCache
from yolov5_lifecycle.runtimes.registry import load_runtime

ONE, TWO, THREE, FOUR = (digit * 64 for digit in "1234")
FRAME = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)


def test_what_is_kept_is_read_by_its_key(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    for content in (b"0", b"1"):
        DiskCache(folder).keep(ONE, content)
    DiskCache(folder).keep(TWO, b"2")
    store = DiskCache(folder)
    assert [store.read(key) for key in (ONE, TWO, THREE)] == [b"1", b"2", None]
    assert sorted(file.name for file in folder.iterdir()) == [ONE, TWO]


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1])


def flip_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[-3] ^= 1
    file.write_bytes(content)


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(truncate, id="truncated"),
        pytest.param(flip_a_bit, id="a bit flipped"),
        pytest.param(lambda file: file.write_bytes(b""), id="empty"),
        pytest.param(lambda file: (file.unlink(), file.symlink_to(file)), id="a link to itself"),
    ],
)
def test_a_damaged_file_is_not_read_and_may_be_replaced(
    damage: Callable[[Path], object], tmp_path: Path
) -> None:
    store = DiskCache(tmp_path)
    store.keep(ONE, b"compiled")
    damage(tmp_path / ONE)
    assert store.read(ONE) is None
    store.keep(ONE, b"compiled")
    assert store.read(ONE) == b"compiled"


def test_what_a_killed_process_has_left_half_written_is_removed(tmp_path: Path) -> None:
    (tmp_path / f"{FOLDER_PREFIX}abandoned").mkdir()
    (tmp_path / ".notes").mkdir()
    with temporary_folder(tmp_path) as living:
        DiskCache(tmp_path).keep(ONE, b"compiled")
        assert sorted(tmp_path.iterdir()) == sorted([living, tmp_path / ".notes", tmp_path / ONE])


@pytest.mark.parametrize(
    "block",
    [
        pytest.param(Path.touch, id="a file"),
        pytest.param(lambda folder: (folder / ONE / "inside").mkdir(parents=True), id="a folder of its name"),
    ],
)
def test_a_place_that_cannot_be_written_costs_the_memory_only(
    block: Callable[[Path], None], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    block(tmp_path / "folder")
    store = DiskCache(tmp_path / "folder")
    with caplog.at_level(logging.INFO):
        store.keep(ONE, b"compiled")
    assert store.read(ONE) is None
    assert f"Not cached in {tmp_path}/folder: " in caplog.text
    assert "set XDG_CACHE_HOME to another folder" in caplog.text


def test_what_was_not_used_for_longest_is_cleared_away(tmp_path: Path) -> None:
    store = DiskCache(tmp_path, max_bytes=400)  # three of them, each with a digest of 32 bytes
    for age_s, key in ((30, ONE), (20, TWO), (10, THREE)):
        store.keep(key, b"x" * 100)
        os.utime(tmp_path / key, (0, 1_000_000 - age_s))
    assert store.read(ONE) is not None  # and so used last
    store.keep(FOUR, b"x" * 100)
    assert sorted(file.name for file in tmp_path.iterdir()) == [ONE, THREE, FOUR]


def test_what_is_larger_than_all_that_may_be_kept_is_not_kept(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = DiskCache(tmp_path, max_bytes=100)
    store.keep(ONE, b"x" * 50)
    store.keep(TWO, b"x" * 100)
    assert [file.name for file in tmp_path.iterdir()] == [ONE]
    assert "Not cached, because its 100 bytes exceed the limit" in caplog.text


def test_files_of_others_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_bytes(b"x" * 1000)
    (tmp_path / "folder").mkdir()
    store = DiskCache(tmp_path, max_bytes=200)
    for key in (ONE, TWO):
        store.keep(key, b"x" * 100)
        os.utime(tmp_path / key, (0, 2**33))  # as before a clock is set back: the new one is kept
    assert sorted(file.name for file in tmp_path.iterdir()) == [TWO, "folder", "notes.txt"]


def test_threads_may_keep_the_same_at_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = DiskCache(tmp_path)
    with ThreadPoolExecutor(4) as pool:
        for _ in range(100):
            pool.submit(store.keep, ONE, b"x" * 10_000)
    assert store.read(ONE) == b"x" * 10_000
    assert [file.name for file in tmp_path.iterdir()] == [ONE]
    assert not caplog.text


@pytest.fixture(params=COMPILED_RUNTIMES)
def runtime_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "yolov5_lifecycle" / "compiled"


def predictions(model: Model, runtime_name: str, frame: NDArray[np.uint8] = FRAME) -> NDArray[np.float32]:
    runtime = load_runtime(model, runtime_name, device="cpu", precision="fp32")
    rows = runtime(frame, "rgb").rows
    runtime.close()
    return rows


@pytest.mark.long
def test_whatever_a_compiled_model_depends_on_is_compiled_for_by_itself(
    runtime_name: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = random_model(1)
    other = dataclasses.replace(TINY, strides=(8, 16, 32), anchors_px=TINY.anchors_px[::-1])
    counts = []
    for compiled, frame in (
        (model, FRAME),
        (model, FRAME),
        (random_model(2), FRAME),
        (model, FRAME[:, :64]),
        (Model(other, model.class_names, model.state_dict), FRAME),
    ):
        predictions(compiled, runtime_name, frame)
        counts.append(len(list(cache.iterdir())))
    for part in ("processor", "installed_build"):
        monkeypatch.setattr(compiled_runtime, part, lambda *_: "another")
        predictions(model, runtime_name)
        counts.append(len(list(cache.iterdir())))
    assert counts == [1, 1, 2, 3, 4, 5, 6]


@pytest.mark.long
def test_a_second_load_runs_what_the_first_has_compiled(runtime_name: str, cache: Path) -> None:
    one, other = random_model(1), random_model(2)
    expected = predictions(one, runtime_name)
    np.testing.assert_array_equal(predictions(one, runtime_name), expected)
    (file,) = cache.iterdir()
    compiled = file.read_bytes()
    file.unlink()
    predictions(other, runtime_name)
    (file,) = cache.iterdir()
    file.write_bytes(compiled)
    assert not np.allclose(predictions(other, runtime_name), predictions(other, "torch"), atol=0.01)


@pytest.mark.long
def test_a_compiled_model_that_cannot_be_run_is_recompiled(
    runtime_name: str, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    expected = predictions(random_model(1), runtime_name)
    (file,) = cache.iterdir()
    DiskCache(cache).keep(file.name, b"of a version that nobody reads")
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            np.testing.assert_array_equal(predictions(random_model(1), runtime_name), expected)
    assert caplog.text.count("because the cached one cannot be loaded: ") == 1


@pytest.mark.long
def test_a_machine_without_a_place_for_files_compiles_every_time(
    runtime_name: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.parent.mkdir()
    cache.touch()
    monkeypatch.setattr(tempfile, "tempdir", str(cache / "none"))
    np.testing.assert_allclose(
        predictions(random_model(1), runtime_name), predictions(random_model(1), "torch"), atol=2e-3
    )
