"""The fastest runtime is measured once; a cached result is used only where it is plausible."""

from __future__ import annotations

import importlib.util
import json
import os
import pwd
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.colcon_workspace import SUPPORT_PATH
from support.random_model import TINY, random_model
from support.special_cache_files import SPECIAL_CACHE_FILES

from yolov5_lifecycle.detection.loaded_detector import load_detector
from yolov5_lifecycle.runtimes.auto import Choice, choose_runtime, read_figures, write_figures
from yolov5_lifecycle.runtimes.cache import cache_folder, installed_build
from yolov5_lifecycle.runtimes.registry import (
    REQUIREMENTS,
    RuntimeAbsentError,
    installed_runtimes,
    load_runtime,
)
from yolov5_lifecycle.runtimes.speed import measure_ms
from yolov5_lifecycle.runtimes.torch_device import DeviceError

INSTALLED = installed_runtimes()
needs_choice = pytest.mark.skipif(len(INSTALLED) == 1, reason="torch alone is installed: make install")


def measured(*_: object, **__: object) -> dict[str, float]:
    """In the place of a measurement, which takes seconds."""
    return {name: 100.0 / (index + 1) for index, name in enumerate(INSTALLED)}


def chosen(folder: Path, frame_hw: tuple[int, int] = (64, 96)) -> Choice:
    return choose_runtime(
        random_model(), device="cpu", precision="auto", frame_hw=frame_hw, folder=folder, measure=measured
    )


@pytest.fixture(scope="module")
def record_name(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What a record is called for the model and the frame that `chosen` asks for."""
    folder = tmp_path_factory.mktemp("choices")
    chosen(folder)
    (record,) = folder.iterdir()
    return record.name


@pytest.mark.long
@needs_choice
def test_every_installed_runtime_is_measured_and_the_fastest_taken(tmp_path: Path) -> None:
    choice = choose_runtime(
        random_model(), device="cpu", precision="auto", frame_hw=(64, 96), folder=tmp_path
    )
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
    choice = choose_runtime(
        random_model(),
        device="cpu",
        precision="auto",
        frame_hw=(64, 96),
        folder=tmp_path,
        measure=lambda *_, **__: figures_ms,
    )
    assert choice.runtime == chosen_runtime


@needs_choice
def test_what_was_measured_is_remembered_for_the_size_of_frame(tmp_path: Path) -> None:
    assert chosen(tmp_path).runtime == INSTALLED[-1]
    (record,) = tmp_path.iterdir()
    record.write_text(json.dumps({"torch": 1.5} | dict.fromkeys(INSTALLED[1:], 77.0)))
    again = chosen(tmp_path)
    assert again.runtime == "torch"
    assert again.reason.startswith("torch 1.5 ms, ")
    assert again.reason.endswith(f"; cached in {record}")
    assert chosen(tmp_path, (96, 64)).reason.endswith("; measured now")


@pytest.mark.long
@needs_choice
@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b'{"torch": 1', id="cut off"),
        pytest.param(b"\xff\xfe", id="no text"),
        pytest.param(b"[1]", id="another document"),
        pytest.param(b'{"torch": "fast"}', id="no number"),
        pytest.param(b'{"torch": NaN}', id="not a number"),
        pytest.param(b'{"torch": -1.0}', id="negative"),
        pytest.param(b'{"torch": 1e308}', id="longer than any measurement"),
        pytest.param(b'{"torch": 9.0, "gone": 1.0}', id="runtime that is not installed"),
        pytest.param(b'{"onnxruntime": 1.0}', id="torch missing"),
    ],
)
def test_a_damaged_record_is_measured_again_and_replaced(
    tmp_path: Path, content: bytes, record_name: str
) -> None:
    record = tmp_path / record_name
    record.write_bytes(content)
    assert chosen(tmp_path).reason.endswith("; measured now")
    assert chosen(tmp_path).reason.endswith(f"; cached in {record}")


@pytest.mark.long
@needs_choice
@pytest.mark.parametrize("make", SPECIAL_CACHE_FILES.values(), ids=SPECIAL_CACHE_FILES)
def test_what_is_no_record_is_replaced(
    tmp_path: Path, make: Callable[[Path], object], record_name: str
) -> None:
    record = tmp_path / record_name
    make(record)
    assert chosen(tmp_path).reason.endswith("; measured now")
    assert chosen(tmp_path).reason.endswith(f"; cached in {record}")


@needs_choice
def test_a_record_that_is_a_folder_stays_and_costs_the_memory_only(tmp_path: Path, record_name: str) -> None:
    (tmp_path / record_name).mkdir()
    assert "; measured now, not cached: " in chosen(tmp_path).reason
    assert [path.name for path in tmp_path.iterdir()] == [record_name]


@needs_choice
def test_a_folder_that_cannot_be_written_costs_the_memory_only(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    choice = chosen(tmp_path / "file" / "folder")
    assert choice.runtime in INSTALLED
    assert "; measured now, not cached: " in choice.reason


@needs_choice
def test_a_user_without_a_home_folder_lacks_the_memory_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a container's process whose user id stands in no passwd file."""

    def unknown(user_id: int) -> None:
        raise KeyError(user_id)

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    choice = choose_runtime(
        random_model(), device="cpu", precision="auto", frame_hw=(64, 96), measure=measured
    )
    assert choice.runtime == INSTALLED[-1]
    assert choice.reason.endswith("; measured now, not cached: Could not determine home directory.")


@needs_choice
def test_a_record_in_the_home_folder_is_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert chosen(Path("~/choices")).reason.endswith("; measured now")
    assert chosen(Path("~/choices")).reason.endswith(".json")
    assert [folder.name for folder in tmp_path.iterdir()] == ["choices"]


@pytest.mark.parametrize(
    ("device", "precision"), [("cuda:99", "auto"), ("cpu", "fp16")], ids=["absent device", "half on a CPU"]
)
def test_what_no_runtime_can_do_is_refused(tmp_path: Path, device: str, precision: str) -> None:
    with pytest.raises(DeviceError):
        choose_runtime(random_model(), device=device, precision=precision, frame_hw=(64, 64), folder=tmp_path)


@pytest.mark.parametrize("precision", ["int8", "bf16"])
def test_what_one_runtime_computes_is_not_measured(tmp_path: Path, precision: str) -> None:
    choice = choose_runtime(
        random_model(), device="cpu", precision=precision, frame_hw=(64, 64), folder=tmp_path
    )
    assert choice == Choice("openvino", f"the only one for {precision}")
    assert list(tmp_path.iterdir()) == []


def test_auto_loads_what_was_chosen_and_says_why() -> None:
    detector = load_detector(random_model(), device="cpu", image_size=64)
    assert detector.runtime.name in INSTALLED
    assert " ms" in detector.choice or len(INSTALLED) == 1


def test_a_runtime_that_cannot_be_loaded_is_left_out_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    figures_ms = measure_ms(random_model(), ["torch", "tensorrt"], precision="fp32", frame_hw=(64, 64))
    assert list(figures_ms) == ["torch"]
    assert "'tensorrt' was not measured, because it failed: Runtime must be one of auto, torch" in caplog.text


def test_figures_are_read_as_they_were_written(tmp_path: Path) -> None:
    record = tmp_path / "deep" / "record.json"
    assert read_figures(record, ["torch"]) is None
    assert write_figures(record, {"torch": 12.5}) == ""
    assert read_figures(record, ["torch"]) == {"torch": 12.5}
    assert [file.name for file in record.parent.iterdir()] == ["record.json"]


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
    assert cache_folder("choices") == Path(expected)


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which packages are found, of which no distribution knows."""
    folder = tmp_path / "packages"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    return folder


@needs_choice
def test_it_does_not_matter_which_distribution_a_package_is_from(
    tmp_path: Path, packages: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with onnxruntime from onnxruntime-gpu."""
    for package in {package for runtime in INSTALLED for package in REQUIREMENTS[runtime]}:
        spec = importlib.util.find_spec(package)
        assert spec is not None
        assert spec.origin is not None
        (packages / package).symlink_to(Path(spec.origin).parent)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if not path.endswith("-packages")])
    assert chosen(tmp_path / "choices").runtime == INSTALLED[-1]


def test_another_version_of_a_package_is_another_build(packages: Path) -> None:
    assert installed_build("sparkling_runtime") is None
    file = packages / "sparkling_runtime" / "__init__.py"
    file.parent.mkdir()
    importlib.invalidate_caches()
    assert installed_build("sparkling_runtime") is None, "a folder that only has the name"
    file.touch()
    importlib.invalidate_caches()
    first = installed_build("sparkling_runtime")
    os.utime(file, (1, 1))
    assert first is not None
    assert installed_build("sparkling_runtime") not in (None, first)


ABSENT = "sys.modules.update(dict.fromkeys(['onnxruntime', 'openvino', 'onnx']))"
MERE_FOLDER = (
    "sys.modules['openvino'] = ModuleType('openvino'); "
    "sys.modules['openvino'].__spec__ = ModuleSpec('openvino', None)"
)


@pytest.mark.long
@pytest.mark.parametrize(
    ("runtime", "preparation"),
    [
        pytest.param("onnxruntime", ABSENT, id="onnxruntime"),
        pytest.param("openvino", ABSENT, id="openvino", marks=pytest.mark.long),
        pytest.param("openvino", MERE_FOLDER, id="a folder called openvino", marks=pytest.mark.long),
    ],
)
def test_a_runtime_that_is_not_installed_says_how_to_install_it(runtime: str, preparation: str) -> None:
    """In a process of its own, where its packages cannot be found."""
    script = (
        "import sys; from importlib.machinery import ModuleSpec; from types import ModuleType\n"
        f"{preparation}\n"
        "from support.random_model import random_model\n"
        "from yolov5_lifecycle.runtimes.registry import load_runtime\n"
        f"load_runtime(random_model(), '{runtime}', device='cpu', precision='auto')\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | SUPPORT_PATH, capture_output=True, text=True
    )
    assert f"RuntimeAbsentError: Runtime '{runtime}' is not installed" in run.stderr
    assert f"{sys.executable} -m pip install {' '.join(REQUIREMENTS[runtime])}, or use 'auto'" in run.stderr


@pytest.mark.long
def test_a_runtime_that_fails_when_imported_is_not_chosen_and_says_why(tmp_path: Path) -> None:
    """As ONNX Runtime compiled for another numpy; in a process of its own, where that module comes first."""
    broken = tmp_path / "onnxruntime" / "__init__.py"
    broken.parent.mkdir()
    broken.write_text("raise AttributeError('_ARRAY_API not found')\n")
    script = (
        "from pathlib import Path\n"
        "from support.random_model import random_model\n"
        "from yolov5_lifecycle.runtimes.auto import choose_runtime\n"
        "from yolov5_lifecycle.runtimes.registry import load_runtime\n"
        "model = random_model()\n"
        f"folder = Path({str(tmp_path)!r})\n"
        "choice = choose_runtime(model, device='cpu', precision='auto', frame_hw=(64, 64), folder=folder)\n"
        "print(choice.runtime)\n"
        "load_runtime(model, 'onnxruntime', device='cpu', precision='auto')\n"
    )
    path = f"{tmp_path}{os.pathsep}{SUPPORT_PATH['PYTHONPATH']}"
    run = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert run.stdout.strip() in ("openvino", "torch")
    assert "Runtime 'onnxruntime' was not measured, because it failed" in run.stderr
    assert "Runtime 'onnxruntime' cannot be imported (AttributeError: _ARRAY_API not found)" in run.stderr
    assert "-m pip install --force-reinstall onnxruntime onnx, or use 'auto'." in run.stderr


def test_an_unknown_runtime_is_refused_with_those_there_are() -> None:
    with pytest.raises(
        RuntimeAbsentError, match="one of auto, torch, onnxruntime, openvino, found 'tensorrt'"
    ):
        load_runtime(random_model(0, TINY), "tensorrt", device="cpu", precision="auto")
