"""Checks that every request must pass before the application sees it."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from yolov5_lifecycle.ros.console.options import ConsoleOptions
from yolov5_lifecycle.ros.console.sessions import MAX_ADDRESSES, Budget, Sessions

LOGIN, METRICS = "/login", "/metrics"
_REQUESTS_PER_S = 100.0
_REQUESTS = 400
MAX_HEADER_BYTES = 16 * 1024
_TLS_ONLY = "max-age=2592000"
"""Of Strict-Transport-Security: 30 days. Browsers ignore it for an address or an untrusted certificate."""
_OPEN_TO_ALL = (LOGIN, "/page/")
"""Served without a session: the login page and public files."""
_SAFE = ("GET", "HEAD")
_DEFAULT_PORTS = {"http": 80, "https": 443}


class Gate:
    """Passes on to `application` the permitted requests from the page of this console.

    Refuses: requests with a body; too many from one address; large ones; a foreign Host; a foreign Origin, or
    none where a page would send one; with `sessions`, requests without a session.
    `port`: that of the console, part of the name of its cookie.

    The state of a request that is passed on has `is_secure`: whether the page's address begins with https,
    `cookie`: name of the cookie with the id of the session, and `session_left_s`: seconds until the session
    expires, None without `sessions`.
    """

    def __init__(
        self, application: ASGIApp, options: ConsoleOptions, sessions: Sessions | None, *, port: int
    ) -> None:
        self._application = application
        self._addresses = Addresses(options)
        self._sessions = sessions
        self._port = port
        self._requests_of = lru_cache(MAX_ADDRESSES)(lambda _: Budget(_REQUESTS_PER_S, _REQUESTS))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        application = self._application
        try:
            self._check(scope, Headers(scope=scope))
        except HTTPException as refusal:
            application = PlainTextResponse(f"{refusal.detail}\n", refusal.status_code, refusal.headers)
        if scope["type"] == "http" and scope["state"].get("is_secure"):
            send = _over_tls_only(send)
        await application(scope, receive, send)

    def _check(self, scope: Scope, headers: Headers) -> None:
        """Complete the state of the request; raises HTTPException for one that is refused."""
        # A body is not waited for: it may never come, and a proxy may find its end elsewhere (RFC 9112, 6.1).
        closing = {"Connection": "close"}
        if not self._requests_of(_address_of(scope)).spend():
            raise HTTPException(429, "too many requests: wait a second", closing | {"Retry-After": "1"})
        if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
            raise HTTPException(400, "expected a request without a body", closing)
        if _header_bytes(scope) > MAX_HEADER_BYTES:
            raise HTTPException(
                431, f"address and headers of a request may have at most {MAX_HEADER_BYTES} bytes"
            )
        host, *others = headers.getlist("host") or [""]
        scheme = "" if others else self._addresses.scheme_of(host, tuple(scope.get("server") or ("", 0)))
        if not scheme:
            raise HTTPException(
                403,
                "unknown host name or address: open the address that the console printed, or start it with "
                "--public-url",
            )
        scope["state"]["is_secure"] = scheme == "https"
        scope["state"]["cookie"] = cookie_name(self._port, is_secure=scheme == "https")
        self._check_origin(scope, headers.getlist("origin"), host, scheme)
        self._check_session(scope, headers)

    def _check_origin(self, scope: Scope, origins: list[str], host: str, scheme: str) -> None:
        if not origins and (scope["type"] == "websocket" or scope["method"] not in _SAFE):
            raise HTTPException(403, "no Origin header: only this console's own page may do that")
        if origins and (len(origins) > 1 or not self._addresses.is_own_origin(origins[0], host, scheme)):
            raise HTTPException(403, "the Origin is another page: only this console's own page may do that")

    def _check_session(self, scope: Scope, headers: Headers) -> None:
        scope["state"]["session_left_s"] = None
        if self._sessions is None:
            return
        # A program on a neighbouring host name may have set a cookie of the same name.
        ids = values_of(scope["state"]["cookie"], headers.getlist("cookie"))
        left_s = scope["state"]["session_left_s"] = max(map(self._sessions.left_s, ids), default=0.0)
        path = str(scope["path"])
        if path.startswith(_OPEN_TO_ALL) or left_s:
            return
        if path == METRICS:
            if not has_token(self._sessions, scope, headers):
                text = "expected the header Authorization: Bearer TOKEN"
                raise HTTPException(401, text, {"WWW-Authenticate": "Bearer"})
        elif path == "/" and scope["type"] == "http":
            raise HTTPException(303, "log in first, on /login", {"Location": LOGIN})
        else:
            raise HTTPException(401, "log in first, on /login")


def has_token(sessions: Sessions, scope: Scope, headers: Headers) -> bool:
    """Whether the request has the token in its Authorization header. Raises like `Sessions.knows_token`."""
    kind, _, token = headers.get("authorization", "").partition(" ")
    is_given = kind.lower() == "bearer" and bool(token)
    return is_given and sessions.knows_token(token.strip(), _address_of(scope))


def _address_of(scope: Scope) -> str:
    """Address of the client."""
    client = scope.get("client")
    return str(client[0]) if client else ""


def _header_bytes(scope: Scope) -> int:
    address = len(scope.get("raw_path", b"")) + len(scope["query_string"])
    return address + sum(len(name) + len(value) for name, value in scope["headers"])


def _over_tls_only(send: Send) -> Send:
    """`send` that tells the browser to use https alone for this host from now on."""

    async def send_with_header(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message)["Strict-Transport-Security"] = _TLS_ONLY
        await send(message)

    return send_with_header


def cookie_name(port: int, *, is_secure: bool) -> str:
    """Name of the cookie with the id of a session at the console on `port`.

    Browsers accept `__Host-` only over TLS, and from this host alone (RFC 6265bis, 4.1.3.2).
    """
    return f"{'__Host-' if is_secure else ''}console_{port}"


def values_of(name: str, headers: Iterable[str]) -> list[str]:
    """All values of the cookie `name` in the Cookie `headers`.

    Browsers send the cookies of all programs on a host to every port, and others' may be malformed:
    http.cookies.SimpleCookie discards everything after the first pair that it cannot read.
    """
    pairs = (pair.partition("=") for header in headers for pair in header.split(";"))
    return [value.strip(" \t") for found, equals, value in pairs if equals and found.strip(" \t") == name]


class Addresses:
    """The addresses of one console: where it listens, the name of this machine, and its public URLs."""

    def __init__(self, options: ConsoleOptions) -> None:
        self._scheme = options.scheme
        parts = [urlsplit(url) for url in options.public_urls]
        self._public = {(part.scheme, _authority(part.scheme, part.netloc)) for part in parts}
        name = socket.gethostname().lower()
        self._names = {"localhost"} if options.is_loopback else {"localhost", name, f"{name}.local"}

    def scheme_of(self, host: str, server: tuple[str, int]) -> str:
        """Scheme of the page under the Host header `host`, "" for a foreign one.

        `server`: address and port of this machine at which the request arrived.
        """
        for scheme in _DEFAULT_PORTS:
            if (scheme, _authority(scheme, host)) in self._public:
                return scheme
        address, port = _split(host, _DEFAULT_PORTS[self._scheme])
        is_own = port == server[1] and (address in self._names or _same_address(address, server[0]))
        return self._scheme if is_own else ""

    def is_own_origin(self, origin: str, host: str, scheme: str) -> bool:
        """Whether the Origin header is that of the page under the accepted `host`, served as `scheme`."""
        found, _, authority = origin.lower().partition("://")
        return found == scheme and _authority(scheme, authority) == _authority(scheme, host)


def _authority(scheme: str, netloc: str) -> tuple[str, int]:
    return _split(netloc, _DEFAULT_PORTS[scheme])


def _split(netloc: str, default_port: int) -> tuple[str, int]:
    """Name or address in lower case without brackets, and port; ("", 0) for what is neither."""
    with suppress(ValueError):
        parts = urlsplit(f"//{netloc}")
        if parts.netloc == netloc and "@" not in netloc:
            return parts.hostname or "", default_port if parts.port is None else parts.port
    return "", 0


def _same_address(given: str, own: str) -> bool:
    try:
        return ipaddress.ip_address(given) == _unmapped(ipaddress.ip_address(own.partition("%")[0]))
    except ValueError:
        return False


def _unmapped(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> object:
    """The IPv4 address that a socket of IPv6 shows as `::ffff:192.0.2.1`, or `address` itself."""
    return getattr(address, "ipv4_mapped", None) or address
