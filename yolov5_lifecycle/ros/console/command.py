"""Command `console`: a node in its own thread and the web server until a signal, then the exit code."""

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
from yolov5_lifecycle.ros.console.application import WebApplication
from yolov5_lifecycle.ros.console.detectors import Detectors
from yolov5_lifecycle.ros.console.gate import Gate
from yolov5_lifecycle.ros.console.images import Viewers
from yolov5_lifecycle.ros.console.metrics import figures
from yolov5_lifecycle.ros.console.options import ConsoleOptions, parsed
from yolov5_lifecycle.ros.console.pages import Pages
from yolov5_lifecycle.ros.console.ros_thread import RosThread
from yolov5_lifecycle.ros.console.sessions import Sessions, kept_token, usual_path
from yolov5_lifecycle.ros.console.web_server import WebServer, listening_socket
from yolov5_lifecycle.ros.nodes import PrintableNode
from yolov5_lifecycle.ros.services import wrap_services
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
        initialize(given.words)
        if given.problems:
            return refuse(_NAME, " ".join(given.problems))
        node = PrintableNode(_NAME)
    except RuntimeError as error:
        return refuse(_NAME, f"cannot start: {error}")
    wrap_services(node, {})
    try:
        asyncio.run(_serve(node, options, listening_socket(options), _sessions(options)))
    except OSError as error:
        complain(_NAME, error)
        return EXIT_UNABLE
    rclpy.try_shutdown()
    return 0


async def _serve(
    node: PrintableNode, options: ConsoleOptions, sock: socket.socket, sessions: Sessions | None
) -> None:
    """Serve until a signal; afterwards the node may be destroyed."""
    ros = RosThread(node, asyncio.get_running_loop())
    pages = Pages(lambda name: detectors.find(name), lambda: detectors.known, view_only=options.view_only)
    detectors = Detectors(ros, options.nodes, on_change=pages.changed, on_gone=pages.gone)
    viewers = Viewers(ros, detectors.find)
    metrics = figures(lambda: detectors.known, lambda: viewers.count)
    application = WebApplication(pages.serve, viewers.serve, sessions, metrics, node.get_logger())
    server = WebServer(Gate(application, options, sessions, port=sock.getsockname()[1]), options)
    _end_on_signals(server)
    _announce(options, sock)
    ros.start()
    try:
        await detectors.open()
        await server.serve([sock])
    finally:
        ros.stop()


def _end_on_signals(server: WebServer) -> None:
    def end() -> None:
        timer = threading.Timer(_END_S, os._exit, (0,))
        timer.daemon = True
        timer.start()
        server.should_exit = True

    for number in TERMINATION_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # SIGHUP is, under nohup
            asyncio.get_running_loop().add_signal_handler(number, end)


def _sessions(options: ConsoleOptions) -> Sessions | None:
    """Those of the token, if `options` need one; a new one is printed. Raises OSError."""
    if not options.needs_token:
        return None
    path = options.token_file or usual_path(os.environ)
    token, is_new = kept_token(path)
    _say(f"token: {token}\n(shown once; stored in {path})" if is_new else f"the token is in {path}")
    return Sessions(token)


def _announce(options: ConsoleOptions, sock: socket.socket) -> None:
    """Print the address of the page; of all addresses of the machine, under its name."""
    address, port = sock.getsockname()[:2]
    host = socket.gethostname() if address in ("0.0.0.0", "::") else address
    _say(f"{_NAME}: {options.scheme}://{f'[{host}]' if ':' in host else host}:{port}/")
    if not options.is_loopback and not options.certificate:
        _say(
            "Anyone on the network can read the traffic, including the token: use --cert and --key, or put a "
            "reverse proxy with TLS in front (docs/console.md)."
        )


def _say(text: str) -> None:
    write_output(_NAME, text + "\n")


if __name__ == "__main__":
    main()
