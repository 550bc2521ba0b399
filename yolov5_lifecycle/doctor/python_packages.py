"""Python packages: those that are required, and those that are there twice."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.metadata import distributions, requires, version
from pathlib import Path

from yolov5_lifecycle.doctor.finding import Finding, Groups, Machine, error, ok, warning
from yolov5_lifecycle.printable import shell_command
from yolov5_lifecycle.process.missing_package import PIP_PACKAGES

_MODULES = {package: module for module, package in PIP_PACKAGES.items()}
_IMPORTED = ("annotated_types", "cv2", "numpy", "pydantic", "pydantic_core", "safetensors", "yaml")
"""Always needed and quickly imported; torch and the runtimes are imported in processes of their own."""
_ONCE = ("cv2", "numpy", "onnx", "onnxruntime", "openvino", "pydantic", "rclpy", "scipy", "torch", "yaml")
"""Of which a second copy leads to errors that name neither."""
_REQUIREMENT = re.compile(r"([\w.-]+)(?:\s*\(?>=\s*([\d.]+))?")


def _required(_: Machine) -> Iterator[Finding]:
    """Raises what the import of a missing or broken package raises."""
    present = [f"yolov5_lifecycle {version('yolov5_lifecycle')}"]
    for package, oldest, is_optional in dict.fromkeys(_requirements()):
        module = _MODULES.get(package, package)
        try:
            loaded = import_module(module) if module in _IMPORTED else None
            found = getattr(loaded, "__version__", None) or version(package)
        except ModuleNotFoundError:
            if is_optional:
                continue
            raise
        present.append(f"{package} {found}")
        if _numbers(found) < _numbers(oldest):
            yield error(
                f"{package} {found}, expected {oldest} or newer",
                remedy=f'{sys.executable} -m pip install "{package}>={oldest}"',
            )
    yield ok(", ".join(present))


def _requirements() -> Iterator[tuple[str, str, bool]]:
    """Packages of pip, their oldest supported versions, and whether only an extra needs them."""
    for line in requires("yolov5_lifecycle") or []:
        parts = _REQUIREMENT.match(line)
        assert parts is not None
        yield parts[1], parts[2] or "0", "extra ==" in line and "opencv" not in line


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text.partition("+")[0])[:3])


def _duplicates(_: Machine) -> Iterator[Finding]:
    doubled = {module: places for module in _ONCE if len(places := _copies(module)) > 1}
    for module, (used, *hidden) in doubled.items():
        package = PIP_PACKAGES.get(module, module)
        if module == "cv2":  # which several packages of pip have
            names = (str(each.name) for each in distributions(path=[used]))
            package = next((name for name in names if name.startswith("opencv")), package)
        uninstall = shell_command(sys.executable, "-m", "pip", "uninstall", package)
        is_given = used in os.environ.get("PYTHONPATH", "").split(os.pathsep)
        what_to_do = f"Remove {used} from PYTHONPATH" if is_given else f"Uninstall one, such as `{uninstall}`"
        yield warning(
            f"{module} is loaded from {used} and hides {', '.join(hidden)}",
            remedy=f"{what_to_do}, because compiled packages fit only one of the two.",
        )
    if not doubled:
        yield ok("no package is there twice")


def _copies(module: str) -> list[str]:
    """The folders of sys.path from which `module` could be imported, the one that is used first."""
    places: dict[Path, str] = {}
    for entry in filter(None, sys.path):
        spec = PathFinder.find_spec(module, [entry])
        if spec is not None and spec.origin is not None:
            places.setdefault(Path(spec.origin).resolve(), entry)
    return list(dict.fromkeys(places.values()))


# Those that import packages come last: a broken one may end the process.
CHECKS: Groups = {"packages": {"duplicates": _duplicates, "packages": _required}}
