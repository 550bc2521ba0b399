"""The fastest runtime is measured once; a cached result is used only where it is plausible."""

from __future__ import annotations

import importlib.util
import json
import os
import pwd
import sys
from pathlib import Path
from typing import Any

import pytest
from support.random_model import TINY, random_model

from yolov5_lifecycle.atomic_file import FOLDER_PREFIX, temporary_folder
from yolov5_lifecycle.runtimes import registry
from yolov5_lifecycle.runtimes.registry import (
    REQUIREMENTS,
    installed_build,
    installed_runtimes,
    load_runtime,
)
from yolov5_lifecycle.runtimes.runtime_choice import MAX_CACHE_BYTES, Choice, cache_folder, choose_runtime
from yolov5_lifecycle.runtimes.torch_device import DeviceError

INSTALLED = installed_runtimes()
needs_choice = pytest.mark.skipif(len(INSTALLED) == 1, reason="torch alone is installed: make install")


def measured(*_: object, **__: object) -> dict[str, float]:
    """In the place of a measurement, which takes seconds."""
    return {name: 100.0 / (index + 1) for index, name in enumerate(INSTALLED)}


def chosen(folder: Path | None, **changed: Any) -> Choice:
    """By `measured`, unless it is `changed`."""
    usual: dict[str, Any] = {"device": "cpu", "precision": "auto", "frame_hw": (64, 96), "measure": measured}
    return choose_runtime(random_model(), folder=folder, **usual | changed)


@pytest.mark.long
@needs_choice
def test_every_installed_runtime_is_measured_and_the_fastest_taken(tmp_path: Path) -> None:
    choice = chosen(tmp_path, measure=None)
    (record,) = tmp_path.iterdir()
    figures_ms = json.loads(record.read_text())
    assert sorted(figures_ms) == sorted(INSTALLED)
    assert figures_ms[choice.runtime] <= 1.15 * min(figures_ms.values())
    assert choice.reason.endswith("; measured now")
    assert all(f"{name} {ms:.1f} ms" in choice.reason for name, ms in figures_ms.items())


@needs_choice
@pytest.mark.parametrize(
    ("figures_ms", "chosen_runtime"),
    [
        pytest.param(
            {"torch": 50.0, "onnxruntime": 21.0, "openvino": 20.0}, "onnxruntime", id="hardly slower"
        ),
        pytest.param({"torch": 50.0, "onnxruntime": 24.0, "openvino": 20.0}, "openvino", id="clearly slower"),
        pytest.param({"torch": 20.0, "onnxruntime": 24.0, "openvino": 24.0}, "torch", id="both slower"),
        pytest.param({"torch": 20.0, "openvino": 22.0}, "openvino", id="one could not be measured"),
    ],
)
def test_of_nearly_equal_runtimes_the_one_least_slowed_by_other_processes_is_chosen(
    tmp_path: Path, figures_ms: dict[str, float], chosen_runtime: str
) -> None:
    assert chosen(tmp_path, measure=lambda *_, **__: figures_ms).runtime == chosen_runtime


@needs_choice
def test_what_was_measured_is_remembered_for_the_size_of_frame(tmp_path: Path) -> None:
    assert chosen(tmp_path).runtime == INSTALLED[-1]
    (record,) = tmp_path.iterdir()
    figures_ms = {"torch": 1.5} | dict.fromkeys(INSTALLED[1:], 77.0)
    record.write_text(json.dumps(figures_ms))
    again = chosen(tmp_path)
    assert again.runtime == "torch"
    assert again.reason.startswith("torch 1.5 ms, ")
    assert again.reason.endswith(f"; cached in {record}")
    assert chosen(tmp_path, frame_hw=(96, 64)).reason.endswith("; measured now")


@needs_choice
@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b'{"torch": 1', id="cut off"),
        pytest.param(b'{"torch": 1.0}' + b" " * MAX_CACHE_BYTES, id="too large"),
        pytest.param(b"[1.0]", id="a list"),
        pytest.param(b"{}", id="no runtime"),
        pytest.param(b'{"torch": 9.0, "tosch": 1.0}', id="a runtime unknown"),
        pytest.param(b'{"torch": "1.0"}', id="a text"),
        pytest.param(b'{"torch": NaN}', id="no number"),
    ],
)
def test_a_damaged_record_is_measured_again_and_replaced(tmp_path: Path, content: bytes) -> None:
    chosen(tmp_path)
    (record,) = tmp_path.iterdir()
    record.write_bytes(content)
    assert chosen(tmp_path).reason.endswith("; measured now")
    assert chosen(tmp_path).reason.endswith(f"; cached in {record}")


@needs_choice
def test_a_folder_that_cannot_be_written_costs_the_memory_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    choice = chosen(tmp_path / "file" / "folder")
    assert choice.runtime in INSTALLED
    assert choice.reason.endswith("; measured now")
    assert "Not cached in " in caplog.text
    assert "set XDG_CACHE_HOME" in caplog.text


@needs_choice
def test_a_user_without_a_home_folder_lacks_the_memory_only(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As a container's process whose user id stands in no passwd file."""

    def unknown(user_id: int) -> None:
        raise KeyError(user_id)

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    choice = chosen(None)
    assert choice.runtime == INSTALLED[-1]
    assert "yolov5_lifecycle/choices: Could not determine home directory." in caplog.text


@pytest.mark.parametrize(
    ("device", "precision"), [("cuda:99", "auto"), ("cpu", "fp16")], ids=["absent device", "half on a CPU"]
)
def test_what_no_runtime_can_do_is_refused(tmp_path: Path, device: str, precision: str) -> None:
    with pytest.raises(DeviceError):
        chosen(tmp_path, device=device, precision=precision)


@pytest.mark.parametrize("precision", ["int8", "bf16"])
def test_what_one_runtime_computes_is_not_measured(tmp_path: Path, precision: str) -> None:
    assert chosen(tmp_path, precision=precision) == Choice("openvino", f"the only one for {precision}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("cache", "expected"),
    [
        pytest.param("/somewhere", "/somewhere/yolov5_lifecycle/choices", id="set"),
        pytest.param("", "~/.cache/yolov5_lifecycle/choices", id="empty"),
        pytest.param("relative", "~/.cache/yolov5_lifecycle/choices", id="relative, which counts as unset"),
    ],
)
def test_the_folder_is_the_users_cache(monkeypatch: pytest.MonkeyPatch, cache: str, expected: str) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", cache)
    assert cache_folder() == Path(expected)


@needs_choice
def test_what_a_killed_process_has_left_half_written_is_removed(tmp_path: Path) -> None:
    (tmp_path / f"{FOLDER_PREFIX}abandoned").mkdir()
    with temporary_folder(tmp_path) as living:
        chosen(tmp_path)
        assert [path for path in tmp_path.iterdir() if path.is_dir()] == [living]


def test_another_version_of_a_package_is_another_build(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever distribution it is from: onnxruntime may come from onnxruntime-gpu."""
    monkeypatch.syspath_prepend(tmp_path)
    assert installed_build("sparkling_runtime") is None
    file = tmp_path / "sparkling_runtime" / "__init__.py"
    file.parent.mkdir()
    importlib.invalidate_caches()
    assert installed_build("sparkling_runtime") is None, "a folder that only has the name"
    file.touch()
    importlib.invalidate_caches()
    first = installed_build("sparkling_runtime")
    os.utime(file, (1, 1))
    assert first is not None
    assert installed_build("sparkling_runtime") not in (None, first)


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
def test_a_runtime_that_is_not_installed_says_how_to_install_it(
    runtime: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "installed_build", lambda _: None)
    with pytest.raises(DeviceError) as refusal:
        load_runtime(random_model(), runtime, device="cpu", precision="auto")
    command = f"{sys.executable} -m pip install {' '.join(REQUIREMENTS[runtime])}"
    assert f"Runtime '{runtime}' is not installed" in str(refusal.value)
    assert f"{command}, or use 'auto'" in str(refusal.value)


@needs_choice
def test_a_runtime_that_fails_when_imported_is_not_chosen_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As ONNX Runtime compiled for another numpy."""

    def fail(runtime: str, precision: str) -> None:
        raise AttributeError("_ARRAY_API not found")

    monkeypatch.setattr(registry, "_engine", fail)
    assert chosen(tmp_path, measure=None).runtime == "torch"
    assert "Runtime 'onnxruntime' was not measured, because it failed" in caplog.text
    assert "Runtime 'onnxruntime' cannot be imported (AttributeError: _ARRAY_API not found)" in caplog.text
    assert "-m pip install --force-reinstall onnxruntime onnx, or use 'auto'." in caplog.text


def test_an_unknown_runtime_is_refused_with_those_there_are() -> None:
    with pytest.raises(DeviceError, match="one of auto, torch, onnxruntime, openvino, found 'tensorrt'"):
        load_runtime(random_model(0, TINY), "tensorrt", device="cpu", precision="auto")
