"""The console's own cookie among those of all programs on its host: browsers send them to every port."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

_NAME = "console_"
_HOST_PREFIX = "__Host-"
"""Browsers accept such a cookie only over TLS, and from this host alone (RFC 6265bis, 4.1.3.2)."""


def cookie_name(port: int, *, is_secure: bool) -> str:
    """Name of the cookie with the id of a session at the console on `port`."""
    return f"{_HOST_PREFIX if is_secure else ''}{_NAME}{port}"


def values_of(name: str, headers: Iterable[str]) -> list[str]:
    """All values of the cookie `name` in the Cookie `headers`; those of other programs may be malformed."""
    return [value for found, value in _pairs(headers) if found == name]


def of_consoles(header: str) -> str:
    """The Cookie `header` without the cookies of other programs."""
    return "; ".join(
        f"{name}={value}"
        for name, value in _pairs([header])
        if name.removeprefix(_HOST_PREFIX).startswith(_NAME)
    )


def _pairs(headers: Iterable[str]) -> Iterator[tuple[str, str]]:
    # http.cookies.SimpleCookie discards everything after the first pair that it cannot read.
    for header in headers:
        for pair in header.split(";"):
            name, equals, value = pair.partition("=")
            if equals:
                yield name.strip(" \t"), value.strip(" \t")
