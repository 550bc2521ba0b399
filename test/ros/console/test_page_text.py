"""The parts of the page that compute, run in the browser; and the files that it consists of."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from selenium.webdriver import Chrome
from support.colcon_workspace import REPOSITORY
from support.console_process import address, console_process
from support.worker import worker_domain

from yolov5_lifecycle.settings.parameter_file import read_parameter_file

FOLDER = REPOSITORY / "yolov5_lifecycle" / "ros" / "console" / "page"
FILES = sorted(FOLDER.iterdir())
MAX_LINES = 250
SVG = "http://www.w3.org/2000/svg"

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def call(browser: Chrome, _isolated: None) -> Iterator[Call]:
    """Calls a function of one of the page's modules: `call("figures.js", "grouped", 12)`."""
    with worker_domain() as domain, console_process(domain) as console:
        browser.get(address(console))

        def call(module: str, function: str, *arguments: object) -> Any:
            return browser.execute_async_script(
                "const [module, name, values, done] = arguments;"
                "import('/page/' + module).then((found) => done(found[name](...values)));",
                module,
                function,
                list(arguments),
            )

        yield call


def parameter(name: str, kind: str, value: object, default: object = None) -> dict[str, object]:
    """A parameter as the page receives it."""
    return {"name": name, "type": kind, "value": value, "is_shown": True, "default": default}


def written(call: Call, folder: Path, *parameters: dict[str, object]) -> dict[str, object]:
    """What a node reads from the file that the page makes."""
    file = folder / "copied.yaml"
    file.write_text(call("yaml_text.js", "yamlText", list(parameters)))
    (values,) = read_parameter_file(file).values()
    return dict(values)


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "value"),
    [
        pytest.param("bool", True, id="bool"),
        pytest.param("integer", -3, id="integer"),
        pytest.param("double", 1, id="whole-double"),
        pytest.param("double", 1e-7, id="small-double"),
        pytest.param("double", 1e21, id="large-double"),
        pytest.param("string", "", id="empty-string"),
        pytest.param("string", "yes", id="word-of-yaml"),
        pytest.param("string", "12", id="number-as-string"),
        pytest.param("string", 'a "b" \\ c: #d\n\te\u0085f\u2028g\u007f', id="special-characters"),
        pytest.param("string_array", [], id="empty-list"),
        pytest.param("string_array", ["person", "2", "no, thanks", "猫"], id="list"),
    ],
)
def test_a_value_is_read_as_it_was(call: Call, tmp_path: Path, kind: str, value: object) -> None:
    read = written(call, tmp_path, parameter("name", kind, value))["name"]
    assert read == value
    assert type(read) is {"double": float}.get(kind, type(value))


@pytest.mark.long
@given(strings=st.lists(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"))))
def test_strings_are_read_as_they_were(
    call: Call, tmp_path_factory: pytest.TempPathFactory, strings: list[str]
) -> None:
    folder = tmp_path_factory.mktemp("yaml")
    assert written(call, folder, parameter("classes", "string_array", strings))["classes"] == strings


@pytest.mark.long
@given(number=st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False))  # rcl: strings
def test_numbers_are_read_as_they_were(
    call: Call, tmp_path_factory: pytest.TempPathFactory, number: float
) -> None:
    folder = tmp_path_factory.mktemp("yaml")
    read = written(call, folder, parameter("rate", "double", number))["rate"]
    assert (type(read), read) == (float, number)


@pytest.mark.long
def test_only_what_differs_is_written_and_each_override_of_a_camera(call: Call, tmp_path: Path) -> None:
    read = written(
        call,
        tmp_path,
        parameter("lazy", "bool", True, True),
        parameter("max_rate", "double", 5, 0),
        parameter("front.max_rate", "double", 0, 0),
        parameter("rear.max_rate", "double", None, 0),
    )
    assert read == {"max_rate": 5.0, "front.max_rate": 0.0}


@pytest.mark.long
def test_without_a_difference_the_text_is_a_remark(call: Call) -> None:
    text = call("yaml_text.js", "yamlText", [parameter("lazy", "bool", True, True)])
    assert text == "# Every parameter has its default.\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("value", "limit"), [(0, 1), (0.02, 0.02), (0.3, 0.5), (1, 1), (15.2, 20), (50, 50), (51, 100)]
)
def test_a_plot_ends_at_the_next_round_number(call: Call, value: float, limit: float) -> None:
    assert call("history_view.js", "roundedUp", value) == pytest.approx(limit)


@pytest.mark.long
@pytest.mark.parametrize(
    ("values", "runs"),
    [
        pytest.param([], [], id="empty"),
        pytest.param([None, None], [], id="nothing"),
        pytest.param([1, 2], [[[1, 1], [0, 2]]], id="one"),
        pytest.param([1, None, 2, 3, None], [[[4, 1]], [[2, 2], [1, 3]]], id="gap"),
    ],
)
def test_a_line_has_gaps_where_nothing_was_known(
    call: Call, values: list[int | None], runs: list[list[list[int]]]
) -> None:
    assert call("history_view.js", "runs", values) == runs


@pytest.mark.long
@pytest.mark.parametrize(("count", "text"), [(0, "0"), (999, "999"), (1000, "1 000"), (1234567, "1 234 567")])
def test_counts_are_grouped(call: Call, count: int, text: str) -> None:
    assert call("figures.js", "grouped", count).replace("\u202f", " ") == text


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_a_file_of_the_page_is_small_and_names_no_other_server(file: Path) -> None:
    text = file.read_text()
    assert len(text.splitlines()) <= MAX_LINES
    assert re.findall(r"//[\w-]+\.[\w.-]+", text.replace(SVG, "")) == []
    assert re.findall(r"(?:inner|outer)HTML|insertAdjacent|document\.write|\beval\(|new Function", text) == []


@pytest.mark.parametrize("file", [file for file in FILES if file.suffix == ".js"], ids=lambda file: file.name)
def test_a_module_is_used_and_imports_what_exists(file: Path) -> None:
    names = {found.name for found in FILES}
    imported = set(re.findall(r'from "\./([\w.]+)"', file.read_text()))
    assert imported <= names
    pages = [found.read_text() for found in FILES if found != file]
    assert any(f"/{file.name}" in text for text in pages)


@pytest.mark.parametrize("file", [FOLDER / "index.html", FOLDER / "login.html"], ids=lambda file: file.name)
def test_a_page_names_files_that_exist_and_has_no_script_or_style_of_its_own(file: Path) -> None:
    text = file.read_text()
    named = re.findall(r'(?:href|src)="/page/([^"]+)"', text)
    assert named
    assert [name for name in named if not (FOLDER / name).is_file()] == []
    assert re.findall(r"<style|<script(?! type=\"module\" src=)| style=| on\w+=", text) == []
