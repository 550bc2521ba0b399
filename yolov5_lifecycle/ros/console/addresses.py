"""Addresses under which the page is served; others are foreign pages or names (DNS rebinding)."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

_DEFAULT_PORTS = {"http": 80, "https": 443}


class Addresses:
    """The addresses of one console: where it listens, the name of this machine, and `public_urls`.

    `scheme`: http or https, as the console itself serves it.
    """

    def __init__(self, *, scheme: str, public_urls: Sequence[str] = (), is_loopback: bool) -> None:
        self._scheme = scheme
        parts = [urlsplit(url) for url in public_urls]
        self._public = {(part.scheme, _authority(part.scheme, part.netloc)) for part in parts}
        name = socket.gethostname().lower()
        self._names = {"localhost"} if is_loopback else {"localhost", name, f"{name}.local"}

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
    text = netloc.lower()
    if text.startswith("["):
        name, closing, rest = text[1:].partition("]")
        colon, port = rest[:1], rest[1:]
        if not closing or colon not in ("", ":"):
            return "", 0
    else:
        name, colon, port = text.partition(":")
    if not colon:
        return name, default_port
    return (name, int(port)) if port.isascii() and port.isdigit() and len(port) <= 5 else ("", 0)


def _same_address(given: str, own: str) -> bool:
    try:
        return ipaddress.ip_address(given) == _unmapped(ipaddress.ip_address(own.partition("%")[0]))
    except ValueError:
        return False


def _unmapped(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> object:
    """The IPv4 address that a socket of IPv6 shows as `::ffff:192.0.2.1`, or `address` itself."""
    return getattr(address, "ipv4_mapped", None) or address
