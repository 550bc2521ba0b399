"""Command `console`: the server until a signal, then its exit code."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
import threading
from collections.abc import Sequence
from typing import NoReturn

import rclpy

from yolov5_lifecycle.commands.entry_points import EXIT_UNABLE
from yolov5_lifecycle.process.standard_streams import complain, flush_output, write_output
from yolov5_lifecycle.process.termination import TERMINATION_SIGNALS
from yolov5_lifecycle.ros.console.console import Console
from yolov5_lifecycle.ros.console.options import ConsoleOptions, parsed
from yolov5_lifecycle.ros.console.token_file import TokenFileError, kept_token, usual_path
from yolov5_lifecycle.ros.console.web_server import ListenError, listening_socket, url_of
from yolov5_lifecycle.ros.printable_logger import PrintableNode
from yolov5_lifecycle.ros.services import harden
from yolov5_lifecycle.ros.start_arguments import initialize, refuse, start_arguments

_NAME = "console"
_END_S = 1.8
"""The process ends this long after the first signal, even if something hangs."""


def main(args: Sequence[str] | None = None) -> NoReturn:
    """Serve until a signal, then exit with code 0.

    The exit code is 1 if the address or the token cannot be used, 2 for invalid arguments.
    """
    code = _run(list(sys.argv if args is None else args))
    # A hung ROS thread must not delay the exit.
    flush_output(_NAME, code)
    os._exit(code)


def _run(arguments: list[str]) -> int:
    try:
        given = start_arguments(arguments)
        options = parsed(given.own_words)
        given = initialize(given)
        if given.problems:
            return refuse(_NAME, " ".join(given.problems))
        node = PrintableNode(_NAME)
    except RuntimeError as error:
        return refuse(_NAME, f"cannot start: {error}")
    harden(node, {})
    try:
        token = _token(options)
        sock = listening_socket(options)
        asyncio.run(_serve(node, options, sock, token))
    except (ListenError, TokenFileError, FileNotFoundError) as error:
        complain(_NAME, error)
        return EXIT_UNABLE
    rclpy.try_shutdown()
    return 0


async def _serve(node: PrintableNode, options: ConsoleOptions, sock: socket.socket, token: str) -> None:
    console = Console(node, options, sock, token=token)
    loop = asyncio.get_running_loop()

    def end() -> None:
        timer = threading.Timer(_END_S, os._exit, (0,))
        timer.daemon = True
        timer.start()
        console.stop()

    for number in TERMINATION_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # SIGHUP is, under nohup
            loop.add_signal_handler(number, end)
    _announce(options, sock)
    await console.serve()


def _token(options: ConsoleOptions) -> str:
    """The token, if `options` need one; a new one is printed. Raises TokenFileError."""
    if not options.needs_token:
        return ""
    path = options.token_file or usual_path(os.environ)
    token, is_new = kept_token(path)
    _say(f"token: {token}\n(shown once; stored in {path})" if is_new else f"the token is in {path}")
    return token


def _announce(options: ConsoleOptions, sock: socket.socket) -> None:
    scheme = "https" if options.certificate else "http"
    _say(f"{_NAME}: {url_of(sock, scheme)}")
    if not options.is_loopback and not options.certificate:
        _say(
            "Anyone on the network can read the traffic, including the token: use --cert and --key, or put a "
            "reverse proxy with TLS in front (docs/console.md)."
        )


def _say(text: str) -> None:
    write_output(_NAME, text + "\n")


if __name__ == "__main__":
    main()
