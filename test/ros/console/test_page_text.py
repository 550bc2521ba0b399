"""The parts of the page that compute, run in the browser; and the files that it consists of."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from selenium.webdriver import Chrome
from support.colcon_workspace import REPOSITORY
from support.console_process import address, console_process
from support.worker import worker_domain

from yolov5_lifecycle.settings.parameter_file import read_parameter_file

FOLDER = REPOSITORY / "yolov5_lifecycle" / "ros" / "console" / "page"
SVG = "http://www.w3.org/2000/svg"

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def call(browser: Chrome, _isolated: None) -> Iterator[Call]:
    """Calls a function of one of the page's modules: `call("element.js", "tenth", 12)`."""
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


def yaml_of(call: Call, *parameters: tuple[str, str, object, object]) -> str:
    """The text that the page makes of parameters with name, type, value and default."""
    keys = ("name", "type", "value", "default")
    shown = [dict(zip(keys, one, strict=True)) | {"is_shown": True} for one in parameters]
    return str(call("parameter_values.js", "yamlText", shown))


@pytest.mark.long
@given(
    strings=st.lists(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"))),
    number=st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False),  # rcl: strings
)
@example(strings=["", "yes", "12", 'a "b" \\ c: #d\n\te\u0085f\u2028g\u007f'], number=1e21)
@example(strings=[], number=1)
def test_values_of_every_type_are_read_as_they_were(
    call: Call, tmp_path_factory: pytest.TempPathFactory, strings: list[str], number: float
) -> None:
    given = {
        "classes": ("string_array", strings),
        **{f"string{index}": ("string", text) for index, text in enumerate(strings)},
        "rate": ("double", number),
        "count": ("integer", -3),
        "lazy": ("bool", True),
    }
    file = tmp_path_factory.mktemp("yaml") / "copied.yaml"
    file.write_text(yaml_of(call, *((name, kind, value, None) for name, (kind, value) in given.items())))
    read = read_parameter_file(file)["/**"]
    assert read == {name: value for name, (_, value) in given.items()}
    assert [type(read[name]) for name in ("rate", "count", "lazy")] == [float, int, bool]


@pytest.mark.long
def test_only_what_differs_is_written_and_each_override_of_a_camera(call: Call) -> None:
    usual = ("lazy", "bool", True, True)
    overrides = ("front.max_rate", "double", 0, 0), ("rear.max_rate", "double", None, 0)
    assert yaml_of(call, usual) == "# Every parameter has its default.\n"
    written = yaml_of(call, usual, ("max_rate", "double", 5, 0), *overrides)
    assert written == "/**:\n  ros__parameters:\n    max_rate: 5.0\n    front.max_rate: 0.0\n"


@pytest.mark.long
def test_a_plot_ends_at_the_next_round_number_and_has_gaps_where_nothing_was_known(call: Call) -> None:
    limits = {0: 1, 0.02: 0.02, 0.3: 0.5, 1: 1, 15.2: 20, 50: 50, 51: 100}
    found = [call("history_view.js", "roundedUp", value) for value in limits]
    assert found == pytest.approx([*limits.values()])
    values = [1, None, 2, 3, None]
    assert call("history_view.js", "runs", values) == [[[4, 1]], [[2, 2], [1, 3]]]
    assert call("history_view.js", "runs", [None]) == []


def test_every_file_of_the_page_is_used_names_no_other_server_and_sets_no_html() -> None:
    texts = {file.name: file.read_text().replace(SVG, "") for file in FOLDER.iterdir()}
    named = {name for text in texts.values() for name in re.findall(r'(?:"/page/|from "\./)([^"]+)"', text)}
    assert named == texts.keys() - {"index.html", "login.html"}
    wrong = r"//[\w-]+\.[\w.-]+|(?:inner|outer)HTML|insertAdjacent|document\.write|\beval\(|new Function"
    in_markup = r"<style|<script(?! type=\"module\" src=)| style=| on\w+="
    for name, text in texts.items():
        assert re.findall(wrong, text) == [], name
        assert not name.endswith(".html") or re.findall(in_markup, text) == [], name
