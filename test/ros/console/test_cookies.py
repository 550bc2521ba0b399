"""The console's cookie among those of other programs on the same host."""

from __future__ import annotations

import pytest

from yolov5_lifecycle.ros.console.gate import cookie_name, values_of

OWN = "console_8080=abc-_123"
ODD = {
    "JSON": 'prefs={"a":1}',
    "blank": "k=hello world",
    "no equals sign": "consent",
    "empty name": "=nothing",
    "empty value": "k=",
    "empty pair": ";;",
    "quotation mark": 'k="open',
    "comma": "k=1,2,3",
    "brackets": "k=[1](2)<3>",
    "at sign in name": "user@host=1",
    "colon in name": "a:b=1",
    "slash in name": "a/b=1",
    "brackets in name": "list[0]=1",
    "reserved name": "$Version=1",
    "attribute": "Path=/; Expires=Thu, 01 Jan 1970 00:00:00 GMT",
    "letters beyond ASCII": "k=\u00fcber",
    "equals signs": "k=a==",
    "percent": "k=%7B%22a%22%3A1%7D",
    "backslash": "k=a\\\\b",
    "tab": "k=a\tb",
    "longer name": "console_80801=x",
    "name as value": "k=console_8080",
}


@pytest.mark.parametrize("order", ["{odd}; {own}", "{own}; {odd}", "{odd};{own};{odd}"])
@pytest.mark.parametrize("odd", ODD.values(), ids=ODD)
def test_an_odd_cookie_of_another_program_hides_nothing(odd: str, order: str) -> None:
    header = order.format(odd=odd, own=OWN)
    assert values_of("console_8080", [header]) == ["abc-_123"]


@pytest.mark.parametrize(
    ("headers", "values"),
    [
        pytest.param([], [], id="none"),
        pytest.param([""], [], id="empty"),
        pytest.param(["k=1"], [], id="another"),
        pytest.param(["console_8080"], [], id="no value"),
        pytest.param(["Console_8080=a"], [], id="other case"),
        pytest.param(["console_8080=a; console_8080=b"], ["a", "b"], id="twice"),
        pytest.param(["console_8080=a", "console_8080=b"], ["a", "b"], id="two headers"),
    ],
)
def test_all_values_of_the_name_are_found(headers: list[str], values: list[str]) -> None:
    assert values_of("console_8080", headers) == values


def test_with_tls_the_name_binds_the_cookie_to_the_host() -> None:
    assert cookie_name(8080, is_secure=False) == "console_8080"
    assert cookie_name(8080, is_secure=True) == "__Host-console_8080"
