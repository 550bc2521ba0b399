"""Command-line options of the console."""

from __future__ import annotations

import argparse
import ipaddress
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from yolov5_lifecycle.commands.command_line import CommandParser, node_name

DEFAULT_PORT = 8080
_MAX_PORT = 65_535
_URL = re.compile(r"https?://(\[[0-9a-f:.]+\]|[^\s:/?#@\[\]]+)(:[0-9]{1,5})?")


@dataclass(frozen=True)
class ConsoleOptions:
    """Options of one console.

    `host`: an IP address or a host name. `nodes`: full names of the detectors to show; empty:
    all that are found. `public_urls`: further addresses of the page, such as that of a reverse proxy.
    `token_file`: None for the default.
    """

    host: str
    port: int
    nodes: Sequence[str]
    view_only: bool
    public_urls: Sequence[str]
    token_file: Path | None
    certificate: Path | None
    key: Path | None

    @property
    def scheme(self) -> str:
        return "https" if self.certificate else "http"

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can connect."""
        with suppress(ValueError):
            return ipaddress.ip_address(self.host.partition("%")[0]).is_loopback
        return self.host == "localhost"

    @property
    def needs_token(self) -> bool:
        """Whether people outside this machine can reach the page."""
        return not self.is_loopback or bool(self.public_urls)


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > _MAX_PORT:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to {_MAX_PORT}, found '{text}'")
    return int(text)


def _url(text: str) -> str:
    url = text.rstrip("/").lower()
    if not _URL.fullmatch(url):
        expected = "a URL such as https://robot.example: scheme, name and port only"
        raise argparse.ArgumentTypeError(f"expected {expected}, found '{text}'")
    return url


_FILE: dict[str, Any] = {"type": Path, "metavar": "FILE"}
_ARGUMENTS: dict[str, dict[str, Any]] = {
    "--host": {
        "default": "127.0.0.1",
        "help": "address to listen on (default %(default)s: this machine only); any other requires a token",
    },
    "--port": {
        "type": _port,
        "default": DEFAULT_PORT,
        "help": "port (default %(default)s); 0: any free port",
    },
    "--node": {
        "dest": "nodes",
        "type": lambda name: node_name(f"/{name.lstrip('/')}"),
        "action": "append",
        "default": [],
        "metavar": "/NAME",
        "help": "full name of a detector to show; may be repeated (default: all that are found)",
    },
    "--view-only": {"action": "store_true", "help": "disable all changes from the page"},
    "--public-url": {
        "dest": "public_urls",
        "type": _url,
        "action": "append",
        "default": [],
        "metavar": "URL",
        "help": "address under which a reverse proxy shows the page, such as https://robot.example; requires "
        "a token; may be repeated",
    },
    "--token-file": _FILE
    | {"help": "file that stores the token (default: yolov5_console/token in $XDG_STATE_HOME or ~/.ros)"},
    "--cert": _FILE | {"dest": "certificate", "help": "certificate chain (PEM) for TLS; requires --key"},
    "--key": _FILE | {"help": "private key (PEM) of the certificate, without a password"},
}


def parsed(words: Sequence[str]) -> ConsoleOptions:
    """The options in the arguments `words`; exits with code 2 for invalid ones."""
    parser = CommandParser(
        "console",
        description="Shows detectors in a web browser: images, state, parameters, diagnostics. "
        "Stop it with Ctrl-C. ROS arguments follow `--ros-args`; this help does not list them.",
    )
    for name, settings in _ARGUMENTS.items():
        parser.add_argument(name, **settings)
    options = ConsoleOptions(**vars(parser.parse_args(list(words))))
    if (options.certificate is None) != (options.key is None):
        parser.error("--cert and --key: expected both or neither, found one")
    return options
