"""What README and docs/ say of files, commands, parameters, topics and messages is true."""

from __future__ import annotations

import ast
import re
import runpy
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.parameter import Parameter
from support.colcon_workspace import PACKAGE, REPOSITORY, published_files
from support.good_status import GOOD, OF_CAMERAS
from support.pages import (
    IMAGES,
    LAUNCH,
    MIGRATION,
    PAGES,
    README,
    REFERENCE,
    TROUBLESHOOTING,
    blocks,
    declared_arguments,
    every_page,
    spans,
    table,
    topics_of_examples,
    topics_of_readme,
    typed,
)
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.detection.nms import WORTH_TELLING
from yolov5_lifecycle.detection.selection import ClassFilterError, class_ids
from yolov5_lifecycle.images.encodings import ENCODINGS
from yolov5_lifecycle.offline.detect_bag_arguments import command_parser
from yolov5_lifecycle.offline.detector_options import wanted_settings
from yolov5_lifecycle.ros.camera.settings import CameraSettings
from yolov5_lifecycle.ros.detector.node import EXIT_ABANDONED_SESSIONS, EXIT_DEVICE_LOST
from yolov5_lifecycle.ros.parameters.values import coerced
from yolov5_lifecycle.ros.topics import published, subscribed
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS, SETTINGS_BY_NAME, validated
from yolov5_lifecycle.sources.scene import CLASS_NAMES

FILES_OF_USERS = {
    *("data.yaml", "split.yaml", "labels/a/1.txt"),
    *("report.json", "ground_truth.json", "detections.json", "detections_other.json"),
    "detections_in_frame.py",
}
"""What a user gives to `evaluate`, what it writes, and what a user saves from a page."""
POINTER = re.compile(r"\bdocs/[\w-]+\.md(?:#[\w-]+)?")
"""How a message, a comment or a docstring names a page or a section of a page."""
SOURCE_FOLDERS = [REPOSITORY, REPOSITORY / "yolov5_lifecycle"]


def settings_of(text: str) -> dict[str, Any]:
    """The parameters in a parameter file, in the types that the node gives them; QoS is not among them."""
    (node,) = yaml.safe_load(text).values()
    values: dict[str, Any] = {}
    for name, value in node["ros__parameters"].items():
        nested = value if isinstance(value, dict) else {}
        values |= {f"{name}.{below}": nested[below] for below in nested} or {name: value}
    return {
        name: coerced(Parameter(name, value=value), SCHEMA.found([name])).value
        for name, value in values.items()
        if not name.startswith("qos_overrides.")
    }


def plain(default: object) -> object:
    """`default` as a parameter holds it: tuples are lists there."""
    return list(default) if isinstance(default, tuple) else default


@every_page
def test_a_link_leads_to_a_file_or_a_heading(page: Path) -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", page.read_text()) if "://" not in link]
    for path, _, heading in (link.partition("#") for link in links):
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not heading or heading in anchors(target), heading


def anchors(page: Path) -> list[str]:
    """The anchors of the headings of a page, as GitHub names them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return [re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings]


@every_page
def test_a_source_file_that_is_named_exists(page: Path) -> None:
    # What `make` puts below build/ and a command of the docs below found/ is no source.
    pattern = r"(?!build/|found/)[\w/.-]+\.(py|md|yaml|xml|json|txt)"
    named = [span for span in spans(page) if re.fullmatch(pattern, span) and span not in FILES_OF_USERS]
    assert [name for name in named if not any((folder / name).is_file() for folder in SOURCE_FOLDERS)] == []


def test_a_page_that_the_code_names_exists() -> None:
    missing, found = [], 0
    # Tests make up pages, too.
    for file in (file for file in published_files() if file.suffix != ".md" and file.parts[0] != "test"):
        text = (REPOSITORY / file).read_text(errors="ignore")
        for path, _, heading in (pointer.partition("#") for pointer in POINTER.findall(text)):
            found += 1
            page = REPOSITORY / path
            if not page.is_file() or (heading and heading not in anchors(page)):
                missing.append(f"{file}: {path}#{heading}")
    assert found > 20
    assert missing == []


def test_what_is_installed_names_a_heading_of_the_readme_rather_than_the_readme() -> None:
    installed = [
        file
        for file in published_files()
        if file.parts[0] in (PACKAGE, "config", "launch") and file.suffix != ".md"
    ]
    texts = {file: (REPOSITORY / file).read_text(errors="ignore") for file in installed}
    assert len(texts) > 100
    assert [file for file, text in texts.items() if re.search(r"README(?!\.md#)", text)] == []


@every_page
def test_a_make_target_that_is_named_exists(page: Path) -> None:
    targets = re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
    named = {
        word for command in typed(page) + spans(page) for word in re.findall(r"^make ([a-z-]+)", command)
    }
    assert named <= set(targets)


@every_page
def test_a_parameter_in_a_command_exists(page: Path) -> None:
    of_detector = {setting.name for setting in SETTINGS}
    text = "\n".join(typed(page) + spans(page))
    asked = set(re.findall(r"ros2 param \w+ /\S+ ([a-z][\w.]*)", text))
    assert {name for name in asked if SCHEMA.find(name) is None} == set()
    assert set(re.findall(r"-p (\w+):=", text)) <= of_detector | CameraSettings.model_fields.keys()


@every_page
def test_a_detect_bag_command_is_understood(page: Path) -> None:
    for command in typed(page):
        if command.startswith("detect_bag "):
            arguments = command_parser().parse_args(shlex.split(command)[1:])
            wanted_settings(None, arguments.assignments, arguments.node)


@every_page
def test_a_remapped_name_exists(page: Path) -> None:
    of_camera = {"image_raw"}
    remapped = set(re.findall(r"-r '?([~\w/]+):=", "\n".join(typed(page) + spans(page))))
    assert {name.replace("/yolov5/", "~/") for name in remapped} <= topics_of_examples() | of_camera | {
        "__node",
        "__ns",
    }


def test_the_image_is_small_enough_for_a_repository() -> None:
    assert 0 < (REPOSITORY / "docs" / "images" / "annotated.png").stat().st_size <= 150_000


def test_a_parameter_of_the_readme_has_its_true_default() -> None:
    defaults = {setting.name: setting.default for setting in SETTINGS}
    for row in table(README, "Parameters"):
        name, shown = (cell.strip("`") for cell in row[:2])
        assert coerced(Parameter(name, value=yaml.safe_load(shown)), SETTINGS_BY_NAME).value == plain(
            defaults[name]
        ), name


def test_the_topics_of_the_readme_are_those_of_the_node() -> None:
    texts = {
        node.value
        for file in (REPOSITORY / "yolov5_lifecycle" / "ros").glob("*.py")
        if not file.name.startswith("camera")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert topics_of_readme() == {text for text in texts if re.fullmatch(r"~/[a-z0-9_/]+|/diagnostics", text)}


def test_the_encodings_of_the_page_are_those_that_are_understood() -> None:
    rows = table(IMAGES, "Encodings")
    sizes = {name: row[2] for row in rows for name in re.findall(r"`([^`]+)`", row[0])}
    words = {
        (1, 1, 1): "any",
        (1, 2, 1): "even width",
        (2, 2, 1): "even width and height",
        (1, 1, 3): "at least 3 x 3",
    }
    assert sizes == {
        name: words[(*encoding.block_hw, encoding.min_side_px)] for name, encoding in ENCODINGS.items()
    }


def test_the_topics_whose_qos_may_be_overridden_are_those_of_the_page() -> None:
    page = " ".join(IMAGES.read_text().split())
    for kind, topics in (("subscription", subscribed(("",))), ("publisher", published(("",)))):
        clause = re.search(rf"`{kind}` has ([^;.]+)", page)
        assert clause is not None
        assert re.findall(r"`(~[^`]+)`", clause[1]) == list(topics)


def test_the_line_for_apt_is_the_one_that_make_gives() -> None:
    machine = runpy.run_path(str(REPOSITORY / "requirements" / "check_machine.py"))
    assert machine["APT_LINE"] in typed(README)


@every_page
def test_bash_can_parse_what_a_reader_may_type(page: Path) -> None:
    script = "\n".join(typed(page))
    run = subprocess.run(["bash", "-n"], input=script, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")


@every_page
def test_a_python_example_can_be_compiled(page: Path) -> None:
    for program in blocks(page, "python"):
        compile(program, page, "exec")


@pytest.mark.parametrize("page", [page for page in PAGES if page != README], ids=lambda page: page.name)
def test_a_parameter_file_in_the_docs_is_valid(page: Path) -> None:
    for block in blocks(page, "yaml"):
        validated(settings_of(block))


@pytest.mark.usefixtures("ros_domain")
def test_the_readme_shows_the_refusal_of_its_wrong_file(tmp_path: Path) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(blocks(README, "yaml")[-1])
    with ServedNode(Preparations(), arguments=["--ros-args", "--params-file", str(file)]) as served:
        assert not served.transition("configure")
        assert served.status().message + "\n" == blocks(README, "text")[0]


def test_the_readme_shows_how_an_unknown_class_is_refused() -> None:
    with pytest.raises(ClassFilterError) as refused:
        class_ids(["circel"], CLASS_NAMES)
    assert f"Setting parameter failed: classes: {refused.value}" in README.read_text()


def test_the_launch_arguments_are_those_of_the_page() -> None:
    declared = declared_arguments("yolov5.launch.py")
    rows = {row[0].strip("`"): row[1].strip("`") for row in table(LAUNCH, "The detector")}
    assert rows.keys() == declared.keys()
    written = {name: default for name, default in declared.items() if default not in ("", "a file")}
    assert written.items() <= rows.items()


@pytest.mark.parametrize("node", re.findall(r"^## (.*)$", MIGRATION.read_text(), re.MULTILINE))
def test_a_name_that_replaces_that_of_another_node_exists(node: str) -> None:
    known = {setting.name for setting in SETTINGS} | topics_of_readme() | {"yolov5"}
    named = {name for row in table(MIGRATION, node) for name in re.findall(r"`([^`]+)`", row[1])}
    assert named <= known


def test_a_parameter_of_yolo_ros_is_refused_with_the_name_that_the_page_gives() -> None:
    settings = {setting.name for setting in SETTINGS}
    rows = [
        row
        for row in table(MIGRATION, "yolo_ros (mgonzs13/yolo_ros)")
        if row[1].strip("`") in settings and "service" not in row[0]
    ]
    assert len(rows) > 5
    for row in rows:
        for name in re.findall(r"`([^`]+)`", row[0]):
            assert SCHEMA.meant(name) == row[1].strip("`")


def test_a_parameter_of_yolo_ros_without_a_replacement_is_refused_without_another_name() -> None:
    rows = [
        row
        for row in table(MIGRATION, "yolo_ros (mgonzs13/yolo_ros)")
        if row[1] == "-" and "_msgs/" not in row[0]  # no topic
    ]
    names = [name for row in rows for name in re.findall(r"`(\w+)`", row[0])]
    assert len(names) > 5
    assert {name: SCHEMA.meant(name) for name in names} == dict.fromkeys(names)
    assert [name for name in names if SCHEMA.unknown(name).message.endswith("such parameter.")] == []


def test_every_reason_for_silence_is_explained() -> None:
    explained = " ".join(TROUBLESHOOTING.read_text().split())
    folder = REPOSITORY / "yolov5_lifecycle" / "ros" / "detector"
    files = ("diagnostics.py", "camera_status.py", "depth.py")
    sources = [ast.parse((folder / name).read_text()) for name in files]
    functions = [node for source in sources for node in ast.walk(source) if isinstance(node, ast.FunctionDef)]
    told = [
        function
        for function in functions
        if function.name in ("hint", "remark", "_emptiness", "_missing", "_losses")
    ]
    body = ast.Module([statement for function in told for statement in function.body[1:]], [])
    pieces = [
        node.value.strip()
        for node in ast.walk(body)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value
    ]
    assert len(pieces) > 9
    assert [piece for piece in pieces if piece not in explained] == []


def test_the_values_of_the_diagnostics_are_those_of_the_reference() -> None:
    preparation = (REPOSITORY / "yolov5_lifecycle" / "detection" / "prepared_model.py").read_text()
    of_model = re.findall(r'(?:^ {12}|facts\[)"([a-z0-9 ]+)"(?:: |\] = )', preparation, re.MULTILINE)
    of_node = {**GOOD.of_node.values, **OF_CAMERAS.of_node.values}
    shown = [name for row in table(REFERENCE, "Diagnostics") for name in re.findall(r"`([^`]+)`", row[0])]
    assert sorted(shown) == sorted([*of_node, *of_model])
    (of_camera,) = OF_CAMERAS.of_cameras
    assert of_camera.values.keys() <= of_node.keys()


def test_the_exit_codes_of_the_detector_alone_are_those_of_the_reference() -> None:
    codes = {row[0] for row in table(REFERENCE, "Exit codes") if "`detector`" in row[1]}
    missing_package = 1  # see test_process_start.py
    assert codes == {str(missing_package), str(EXIT_DEVICE_LOST), str(EXIT_ABANDONED_SESSIONS)}


@pytest.mark.parametrize("page", ["reference.md", "troubleshooting.md"])
def test_the_pages_say_which_scores_are_noise(page: str) -> None:
    assert f"above {WORTH_TELLING:g}" in " ".join((REPOSITORY / "docs" / page).read_text().split())
