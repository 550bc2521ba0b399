"""Command-line options of the console."""

from __future__ import annotations

import argparse
import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from yolov5_lifecycle.commands.command_line import CommandParser

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080
_MAX_PORT = 65_535


@dataclass(frozen=True)
class ConsoleOptions:
    """Options of one console.

    `host`: an IP address or a host name. `nodes`: full names of the detectors to show; empty:
    all that are found. `public_urls`: further addresses of the page, such as that of a reverse proxy.
    `token_file`: None for the default.
    """

    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT
    nodes: tuple[str, ...] = ()
    view_only: bool = False
    has_metrics: bool = False
    public_urls: tuple[str, ...] = ()
    token_file: Path | None = None
    certificate: Path | None = None
    key: Path | None = None

    @property
    def scheme(self) -> str:
        return "https" if self.certificate else "http"

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can connect."""
        return is_loopback(self.host)

    @property
    def needs_token(self) -> bool:
        """Whether people outside this machine can reach the page."""
        return not self.is_loopback or bool(self.public_urls)


def is_loopback(host: str) -> bool:
    """Whether `host` is an address of this machine that no other can reach."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False


def parsed(words: Sequence[str]) -> ConsoleOptions:
    """The options in the arguments `words`; exits with code 2 for invalid ones."""
    parser = _parser()
    given = parser.parse_args(list(words))
    if not 0 <= given.port <= _MAX_PORT:
        parser.error(f"--port: expected a number from 0 to {_MAX_PORT}, found {given.port}")
    if (given.cert is None) != (given.key is None):
        parser.error("--cert and --key: expected both or neither, found one")
    for name in given.node:
        if not name.startswith("/"):
            parser.error(f"--node: expected a full name such as /yolov5, found '{name}'")
    for url in given.public_url:
        if problem := _url_problem(url):
            parser.error(f"--public-url: {problem}, found '{url}'")
    return ConsoleOptions(
        host=given.host,
        port=given.port,
        nodes=tuple(given.node),
        view_only=given.view_only,
        has_metrics=given.metrics,
        public_urls=tuple(url.rstrip("/").lower() for url in given.public_url),
        token_file=given.token_file,
        certificate=given.cert,
        key=given.key,
    )


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        "console",
        description="Shows detectors in a web browser: images, state, parameters, diagnostics. "
        "Stop it with Ctrl-C. ROS arguments follow `--ros-args`; this help does not list them.",
    )
    add = parser.add_argument
    add(
        "--host",
        default=DEFAULT_HOST,
        help="address to listen on (default %(default)s: this machine only); any other requires a token",
    )
    add("--port", type=int, default=DEFAULT_PORT, help="port (default %(default)s); 0: any free port")
    add(
        "--node",
        action="append",
        default=[],
        metavar="/NAME",
        help="full name of a detector to show; may be repeated (default: all that are found)",
    )
    add("--view-only", action="store_true", help="disable all changes from the page")
    add("--metrics", action="store_true", help="serve metrics for Prometheus on /metrics")
    add(
        "--public-url",
        action="append",
        default=[],
        metavar="URL",
        help="address under which a reverse proxy shows the page, such as https://robot.example; requires a "
        "token; may be repeated",
    )
    add(
        "--token-file",
        type=Path,
        metavar="FILE",
        help="file that stores the token (default: yolov5_console/token in $XDG_STATE_HOME or ~/.ros)",
    )
    add("--cert", type=Path, metavar="FILE", help="certificate chain (PEM) for TLS; requires --key")
    add("--key", type=Path, metavar="FILE", help="private key (PEM) of the certificate, without a password")
    return parser


def _url_problem(url: str) -> str:
    try:
        parts = urlsplit(url)
        _ = parts.port  # raises for a port that is none
    except ValueError:
        return "expected a URL such as https://robot.example"
    if parts.scheme.lower() not in ("http", "https") or not parts.hostname:
        return "expected a URL such as https://robot.example"
    if parts.path.strip("/") or parts.query or parts.fragment or parts.username:
        return "expected scheme, name and port only"
    return ""
