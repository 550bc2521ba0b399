"""Folders import downwards only, without circles; only ros/ knows ROS, one file of it rclpy's internals."""

from __future__ import annotations

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from inspect import getfile
from itertools import chain
from pathlib import Path

import pytest
from rclpy.lifecycle import LifecycleNodeMixin
from rclpy.node import Node
from support.colcon_workspace import REPOSITORY

PACKAGE = REPOSITORY / "yolov5_lifecycle"
ROS_MODULES = (
    "rclpy",
    "ament_index_python",
    "bond",
    "builtin_interfaces",
    "diagnostic_msgs",
    "lifecycle_msgs",
    "rcl_interfaces",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "vision_msgs",
)
# A folder may import folders of lower rows; the first row holds the modules that lie beside the folders.
RANKS = (
    ("printable", "input_file", "folder_listing", "unfinished"),
    ("atomic_file", "process"),
    ("images", "models"),
    ("settings", "checkpoints", "runtimes", "streaming", "sources", "spatial"),
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
# What a user starts, and what makes a detector, a selection or a tracker from settings.
EDGE = (
    *("settings.", "commands.", "offline.", "ros."),
    *("detection.prepared_model", "detection.python_api", "detection.selection"),
    *("tracking.tracked_detection", "collecting.rules"),
)
WITHOUT_TORCH = ("images", "settings", "spatial", "streaming", "sources", "process", "tracking", "evaluation")

PRIVATE_BY_NAME_ONLY = {
    "os._exit",  # documented
    "pickle._Unpickler",  # the C unpickler allocates as many memo entries as a file claims
}


def module_name(path: Path) -> str:
    """The name below the package: `images.encodings`."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py")) if path.name != "__init__.py"}
every_module = pytest.mark.parametrize("module", MODULES)


def imported_names(path: Path) -> set[str]:
    """Everything that the file imports, also inside functions, with the names taken from modules."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def imported_modules(module: str) -> set[str]:
    """The modules of this package that `module` imports."""
    own = {name.removeprefix("yolov5_lifecycle.") for name in imported_names(MODULES[module])}
    return {candidate for candidate in MODULES if own & {candidate, *_members(candidate, own)}}


def _members(module: str, names: set[str]) -> set[str]:
    return {name for name in names if name.rpartition(".")[0] == module}


def folder_of(module: str) -> str:
    return module.partition(".")[0]


def ros_folder_of(module: str) -> str:
    """The folder in `ros/` that `module` lies in; "" for modules beside those folders, and outside."""
    ros, _, rest = module.partition(".")
    return rest.partition(".")[0] if ros == "ros" and "." in rest else ""


@every_module
def test_a_folder_imports_lower_folders_only(module: str) -> None:
    rank = RANK[folder_of(module)]
    others = {other for other in map(folder_of, imported_modules(module)) if other != folder_of(module)}
    assert {other for other in others if RANK[other] >= rank} == set()


def test_every_folder_has_a_rank() -> None:
    assert set(map(folder_of, MODULES)) == set(RANK)


@every_module
def test_a_folder_in_ros_imports_lower_ones_only(module: str) -> None:
    folder = ros_folder_of(module)
    others = {ros_folder_of(other) for other in imported_modules(module)} - {folder}
    if module != "ros.entry_points":  # it starts every node
        assert {other for other in others if ROS_RANK[other] >= ROS_RANK[folder]} == set()


def test_no_module_imports_itself_in_a_circle() -> None:
    sorter = TopologicalSorter({module: imported_modules(module) for module in MODULES})
    try:
        sorter.prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


@every_module
def test_settings_are_imported_at_the_edge_only(module: str) -> None:
    assert module.startswith(EDGE) or "settings.settings" not in imported_modules(module)


@pytest.mark.parametrize(
    ("folders", "blocked"),
    [
        pytest.param(tuple(folder for folder in RANK if folder != "ros"), ROS_MODULES, id="ROS"),
        pytest.param(WITHOUT_TORCH, ("torch", *ROS_MODULES), id="torch"),
        pytest.param(("spatial",), ("cv2", "torch", *ROS_MODULES), id="all but numpy"),
    ],
)
def test_what_does_not_need_a_library_imports_without_it(
    folders: tuple[str, ...], blocked: tuple[str, ...]
) -> None:
    names = [f"yolov5_lifecycle.{module}" for module in MODULES if folder_of(module) in folders]
    program = (
        f"import sys; sys.modules.update(dict.fromkeys({blocked!r})); "
        f"import importlib; [importlib.import_module(name) for name in {names!r}]"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def private_attributes(path: Path) -> set[str]:
    """Private attributes of something other than `self` and `cls`, also as a constant in getattr."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        owner, name = None, ""
        if isinstance(node, ast.Attribute):
            owner, name = node.value, node.attr
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("getattr", "setattr", "hasattr"):
            owner, name = node.args[0], ast.unparse(node.args[1]).strip("'")
        if name == "_replace":  # documented: every named tuple has it
            continue
        if name.startswith("_") and not name.endswith("__") and owner is not None:
            names.add(f"{ast.unparse(owner)}.{name}")
    return {name for name in names if not name.startswith(("self._", "cls._"))}


@every_module
def test_private_parts_of_other_packages_are_used_in_one_file(module: str) -> None:
    if module != "ros.rclpy_internals":
        assert private_attributes(MODULES[module]) - PRIVATE_BY_NAME_ONLY == set()


def attributes_set(path: Path) -> set[str]:
    """Attributes that the classes in the file set on `self`."""
    attributes = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute))
    return {
        node.attr
        for node in attributes
        if isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self"
    }


@pytest.mark.parametrize("module", [module for module in MODULES if module.endswith(".node")])
def test_a_node_sets_no_attribute_of_rclpys_nodes(module: str) -> None:
    upstream = {name for base in (Node, LifecycleNodeMixin) for name in attributes_set(Path(getfile(base)))}
    assert "_parameters" in upstream
    assert attributes_set(MODULES[module]) & upstream == set()


def test_the_console_needs_no_torch_and_the_nodes_no_web_server() -> None:
    web = ("h11", "prometheus_client", "starlette", "uvicorn", "websockets")
    others = ("ros.camera.node", "ros.demo.command", "ros.detector.command")
    for names, blocked in ((["ros.console.command"], ("torch", "cv2")), (others, web)):
        program = (
            f"import sys; sys.modules.update(dict.fromkeys({blocked!r})); import importlib; "
            f"[importlib.import_module('yolov5_lifecycle.' + name) for name in {names!r}]"
        )
        run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr


def test_importing_the_package_loads_no_library_and_changes_no_environment_variable() -> None:
    program = (
        "import os, sys; before = dict(os.environ); import yolov5_lifecycle; dir(yolov5_lifecycle); "
        "print(before == dict(os.environ), sorted({'torch', 'numpy', 'cv2', 'pydantic'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout == "True []\n"


def test_importing_the_detector_loads_no_runtime_and_no_torch() -> None:
    program = (
        "import sys; from yolov5_lifecycle import Detector; "
        "print(sorted(name for name in sys.modules if name.startswith('yolov5_lifecycle.runtimes.')), "
        "sorted({'torch', 'onnxruntime', 'openvino', 'pydantic'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    # The interface, which has the error that the detector raises.
    assert run.stdout == "['yolov5_lifecycle.runtimes.runtime'] []\n"


def code_lines(source: str) -> int:
    """How many lines `source` has, declarations left out.

    A declaration gives a name its type or value without computing: an annotated name in the body of a class
    or a module, as the settings are, with its docstring. Functions, methods, lambdas and comprehensions are
    code, and so are all lines that are not part of a declaration.
    """
    tree = ast.parse(source)
    bodies = [tree.body, *(node.body for node in tree.body if isinstance(node, ast.ClassDef))]
    declared = 0
    for body in bodies:
        for before, node in zip([None, *body], body, strict=False):
            if is_declaration(node) or (is_text(node) and before is not None and is_declaration(before)):
                declared += 1 + (node.end_lineno or node.lineno) - node.lineno
    return len(source.splitlines()) - declared


def is_declaration(node: ast.stmt) -> bool:
    computing = (ast.Lambda, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
    return isinstance(node, ast.AnnAssign) and not any(isinstance(part, computing) for part in ast.walk(node))


def is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


@every_module
def test_no_module_has_more_than_300_lines_of_code(module: str) -> None:
    assert code_lines(MODULES[module].read_text()) <= 300


SETTING = (
    '    size: Annotated[int, Change.LIVE] = Field(\n        3, ge=1, description="Of the box."\n    )\n'
)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        pytest.param("", 0, id="nothing"),
        pytest.param("class A:\n" + 200 * SETTING, 1, id="settings"),
        pytest.param(
            "class A:\n" + 200 * '    size: int = 3\n    """Of the box."""\n', 1, id="with docstrings"
        ),
        pytest.param(200 * "LIMIT: Final = 3\n", 0, id="constants with a type"),
        pytest.param(200 * "LIMIT = 3\n", 200, id="constants without a type"),
        pytest.param("def f():\n" + 200 * "    size: int = 3\n", 201, id="in a function"),
        pytest.param("class A:\n    def f(self):\n" + 200 * "        size: int = 3\n", 202, id="in a method"),
        pytest.param(200 * "SIZES: Final = [\n    size * 2 for size in range(9)\n]\n", 600, id="computed"),
        pytest.param(200 * "# a comment\n" + 50 * "\n", 250, id="comments and empty lines"),
    ],
)
def test_declarations_are_no_lines_of_code(source: str, expected: int) -> None:
    assert code_lines(source) == expected


def test_the_ranks_name_each_folder_once() -> None:
    assert len(list(chain(*RANKS))) == len(RANK)
