"""The web application: the page, its two kinds of WebSockets, login and metrics."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from mimetypes import guess_type

from rclpy.impl.rcutils_logger import RcutilsLogger
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from yolov5_lifecycle.ros.console.gate import LOGIN, METRICS, has_token
from yolov5_lifecycle.ros.console.sessions import SESSION_S, Sessions

_FIGURES_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SESSION_ENDED = 4401

Serve = Callable[[WebSocket], Awaitable[None]]


def page_files() -> dict[str, Response]:
    """All files of the page by name, read once: a request never reaches the file system."""
    folder = files("yolov5_lifecycle.ros.console").joinpath("page")
    return {
        file.name: Response(file.read_bytes(), media_type=guess_type(file.name)[0])
        for file in folder.iterdir()
    }


@dataclass(eq=False)
class WebApplication:
    """Serves the files of the page; `page` and `image` serve WebSockets, `figures` gives the metrics' text.

    Without `sessions` there is no login.
    """

    page: Serve
    image: Serve
    sessions: Sessions | None
    figures: Callable[[], bytes]
    logger: RcutilsLogger

    def __post_init__(self) -> None:
        self._files = page_files()
        routes: list[BaseRoute] = [
            Route("/", lambda _: self._files["index.html"]),
            Route("/page/{name}", self._file),
            Route(LOGIN, self._login_page, methods=["GET"]),
            Route(LOGIN, self._login, methods=["POST"]),
            Route(METRICS, self._metrics),
            WebSocketRoute("/ws", _within_session(self.page)),
            WebSocketRoute("/image", _within_session(self.image)),
        ]
        self._starlette = Starlette(routes=routes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._starlette(scope, receive, send)
        except Exception as error:
            self.logger.error(
                f"unexpected {type(error).__name__} while answering a request: {error}",
                throttle_duration_sec=1.0,
            )
            raise

    def _file(self, request: Request) -> Response:
        if file := self._files.get(request.path_params["name"]):
            return file
        raise HTTPException(404, "page not found")

    async def _metrics(self, _: Request) -> Response:
        return Response(self.figures(), media_type=_FIGURES_TYPE)

    def _login_page(self, _: Request) -> Response:
        return RedirectResponse("/", 303) if self.sessions is None else self._files["login.html"]

    async def _login(self, request: Request) -> Response:
        """Begin a session for the token in the header."""
        if self.sessions is None or not has_token(self.sessions, request.scope, request.headers):
            raise HTTPException(401, "This is not the token of this console.")
        response = Response(status_code=204)
        response.set_cookie(
            request.state.cookie,
            self.sessions.begin(),
            max_age=int(SESSION_S),
            httponly=True,
            samesite="strict",
            secure=request.state.is_secure,
        )
        return response


def _within_session(serve: Serve) -> Serve:
    """`serve`, ended when the session expires; the page then finds that it has to log in again."""

    async def serve_until_end(websocket: WebSocket) -> None:
        try:
            await asyncio.wait_for(serve(websocket), websocket.state.session_left_s)
        except asyncio.TimeoutError:
            with suppress(RuntimeError):  # it was being closed
                await websocket.close(_SESSION_ENDED, "the session has expired: log in again")

    return serve_until_end
