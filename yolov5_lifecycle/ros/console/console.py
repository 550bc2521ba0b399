"""The console: a node in its own thread, and the web server in the event loop."""

from __future__ import annotations

import asyncio
import socket

from rclpy.node import Node

from yolov5_lifecycle.ros.console.addresses import Addresses
from yolov5_lifecycle.ros.console.application import WebApplication
from yolov5_lifecycle.ros.console.detectors import Detectors
from yolov5_lifecycle.ros.console.gate import Gate
from yolov5_lifecycle.ros.console.images import Viewers
from yolov5_lifecycle.ros.console.metrics import figures
from yolov5_lifecycle.ros.console.options import ConsoleOptions
from yolov5_lifecycle.ros.console.page_files import page_files
from yolov5_lifecycle.ros.console.pages import Pages
from yolov5_lifecycle.ros.console.ros_thread import RosThread
from yolov5_lifecycle.ros.console.sessions import Sessions
from yolov5_lifecycle.ros.console.web_server import WebServer


class Console:
    """One console, created in the thread of its event loop; `token` if `options` need one.

    Raises ListenError or FileNotFoundError on construction.
    """

    def __init__(self, node: Node, options: ConsoleOptions, sock: socket.socket, *, token: str) -> None:
        self._ros = RosThread(node, asyncio.get_running_loop())
        self._pages = Pages(
            lambda name: self._detectors.find(name),
            lambda: self._detectors.known,
            view_only=options.view_only,
        )
        self._detectors = Detectors(
            self._ros,
            options.nodes,
            on_change=self._pages.changed,
            on_gone=self._pages.gone,
            on_omitted=self._pages.omitted,
        )
        viewers = Viewers(self._ros, self._detectors.find)
        sessions = Sessions(token) if token else None
        application = WebApplication(
            page_files(),
            page=self._pages.serve,
            image=viewers.serve,
            sessions=sessions,
            figures=figures(lambda: self._detectors.known, lambda: viewers.count)
            if options.has_metrics
            else None,
            logger=node.get_logger(),
        )
        addresses = Addresses(
            scheme="https" if options.certificate else "http",
            public_urls=options.public_urls,
            is_loopback=options.is_loopback,
        )
        gate = Gate(application, addresses, sessions, port=sock.getsockname()[1])
        self._server = WebServer(gate, options, sock)

    async def serve(self) -> None:
        """Serve until `stop`; afterwards the node may be destroyed."""
        self._ros.start()
        try:
            await self._detectors.open()
            await self._server.serve_until_exit()
            await self._detectors.close()
        finally:
            self._ros.stop()

    def stop(self) -> None:
        """End soon."""
        self._server.should_exit = True
