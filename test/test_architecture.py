"""Folders import downwards only, without circles; only ros/ knows ROS."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from inspect import getfile
from pathlib import Path

import pytest
from rclpy.lifecycle import LifecycleNodeMixin
from rclpy.node import Node
from support.colcon_workspace import REPOSITORY
from support.started import printed_by

from yolov5_lifecycle.settings.settings import SETTINGS

PACKAGE = REPOSITORY / "yolov5_lifecycle"
# A folder may import folders of lower rows; the first row is for the modules that lie beside the folders.
RANKS = (
    ("",),
    ("process",),
    ("images", "models"),
    ("spatial",),
    ("settings", "checkpoints", "runtimes", "streaming", "sources"),
    ("quantization",),
    ("detection",),
    ("tracking", "evaluation"),
    ("collecting",),
    ("commands",),
    ("doctor", "offline"),
    ("ros",),
)
RANK = {folder: rank for rank, folders in enumerate(RANKS) for folder in folders}
ROS_RANK = {"": 0, "parameters": 1, "camera": 2, "console": 2, "detector": 2, "demo": 3, "doctor": 4}
WITHOUT_TORCH = ("images", "settings", "spatial", "streaming", "sources", "process", "tracking", "evaluation")


def module_name(path: Path) -> str:
    """The name below the package: `images.encodings`."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


FILES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py")) if path.name != "__init__.py"}


@pytest.fixture(scope="module", autouse=True)
def _forgotten() -> Iterator[None]:
    """The trees take 40 MB, which the tests of other files can do without."""
    yield
    tree_of.cache_clear()


@cache
def tree_of(module: str) -> ast.Module:
    return ast.parse(FILES[module].read_text())


def imported_names(tree: ast.Module) -> set[str]:
    """Everything that a file imports, also inside functions, with the names taken from modules."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@cache
def imported_modules(module: str) -> set[str]:
    """The modules of this package that `module` imports."""
    own = {name.removeprefix("yolov5_lifecycle.") for name in imported_names(tree_of(module))}
    return FILES.keys() & (own | {name.rpartition(".")[0] for name in own})


def folder_of(module: str) -> str:
    """The folder that `module` lies in; "" beside the folders."""
    return module.partition(".")[0] if "." in module else ""


def place_of(module: str) -> tuple[str, str]:
    """The folder of `module`, and for one in `ros/` also that below."""
    folder, _, rest = module.partition(".")
    return folder_of(module), folder_of(rest) if folder == "ros" else ""


def rank_of(module: str) -> tuple[int, int]:
    folder, folder_of_ros = place_of(module)
    return RANK[folder], ROS_RANK[folder_of_ros]


def test_a_folder_imports_lower_folders_only() -> None:
    assert [
        f"{module} imports {other}"
        for module in FILES
        for other in imported_modules(module)
        if place_of(other) != place_of(module) and rank_of(other) >= rank_of(module)
    ] == []


def test_no_module_imports_itself_in_a_circle() -> None:
    sorter = TopologicalSorter({module: imported_modules(module) for module in FILES})
    try:
        sorter.prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def modules_in(*folders: str) -> list[str]:
    return [module for module in FILES if folder_of(module) in folders]


@pytest.mark.long
@pytest.mark.parametrize(
    ("modules", "blocked"),
    [
        pytest.param(modules_in(*WITHOUT_TORCH), ("torch",), id="torch"),
        pytest.param(modules_in("commands", "detection"), ("onnx", "onnxruntime", "openvino"), id="ONNX"),
        pytest.param(["ros.console.command"], ("torch", "cv2"), id="the console"),
        pytest.param(
            ["ros.camera.node", "ros.demo.command", "ros.detector.command"],
            ("h11", "prometheus_client", "starlette", "uvicorn", "websockets"),
            id="a web server",
        ),
    ],
)
def test_what_does_not_need_a_library_imports_without_it(
    modules: list[str], blocked: tuple[str, ...]
) -> None:
    printed_by(
        f"import sys; sys.modules.update(dict.fromkeys({blocked!r})); import importlib; "
        f"[importlib.import_module('yolov5_lifecycle.' + name) for name in {modules!r}]"
    )


def attributes_set(tree: ast.Module) -> set[str]:
    """Attributes that the classes in a file set on `self`."""
    attributes = (node for node in ast.walk(tree) if isinstance(node, ast.Attribute))
    return {
        node.attr
        for node in attributes
        if isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self"
    }


def test_a_node_sets_no_attribute_of_rclpys_nodes() -> None:
    upstream = {
        name
        for base in (Node, LifecycleNodeMixin)
        for name in attributes_set(ast.parse(Path(getfile(base)).read_text()))
    }
    assert "_parameters" in upstream
    assert [
        f"{module} sets {name}"
        for module in FILES
        if module.endswith(".node")
        for name in attributes_set(tree_of(module)) & upstream
    ] == []


def test_importing_the_package_loads_no_library_and_changes_no_environment_variable() -> None:
    program = (
        "import os, sys; before = dict(os.environ); import yolov5_lifecycle; dir(yolov5_lifecycle); "
        "print(before == dict(os.environ), sorted({'torch', 'numpy', 'cv2', 'pydantic'} & set(sys.modules)))"
    )
    assert printed_by(program) == "True []\n"


def test_importing_the_detector_loads_no_runtime_and_no_torch() -> None:
    program = (
        "import sys; from yolov5_lifecycle import Detector; "
        "print(sorted(name for name in sys.modules if name.startswith('yolov5_lifecycle.runtimes.')), "
        "sorted({'torch', 'onnxruntime', 'openvino', 'pydantic'} & set(sys.modules)))"
    )
    # The interface, which has the error that the detector raises.
    assert printed_by(program) == "['yolov5_lifecycle.runtimes.runtime'] []\n"


OF_EXECUTOR = ("ros.detector.", "ros.parameters.", "streaming.")
"""What the executor of the detector runs."""
BLOCKING = {"wait": 1, "join": 1, "acquire": 1, "wait_for": 2}
"""Methods that wait for another thread, and how many arguments they have when the last one is the limit."""


def has_limit(call: ast.Call, method: str) -> bool:
    given = [*call.args, *(keyword.value for keyword in call.keywords)]
    is_endless = any(isinstance(value, ast.Constant) and value.value is None for value in given)
    return len(given) >= BLOCKING[method] and not is_endless


def endless_waits(tree: ast.Module) -> Iterator[str]:
    """Calls that may wait for ever."""
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        method = getattr(call.func, "attr", "")
        if method in BLOCKING and not has_limit(call, method):
            yield ast.unparse(call)


def test_no_callback_in_the_executor_waits_without_a_limit() -> None:
    run = [module for module in FILES if module.startswith(OF_EXECUTOR)]
    assert {f"{module.rpartition('.')[0]}." for module in run} == set(OF_EXECUTOR)
    assert [f"{module}: {call}" for module in run for call in endless_waits(tree_of(module))] == []


def test_every_setting_is_used() -> None:
    text = "\n".join(path.read_text() for module, path in FILES.items() if module != "settings.settings")
    words = set(re.findall(r"\w+", text))
    assert [setting.name for setting in SETTINGS if setting.name not in words] == []
