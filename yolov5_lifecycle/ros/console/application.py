"""The web application: the page, its two kinds of WebSockets, login and metrics."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from importlib.resources import files
from urllib.parse import parse_qs

from rclpy.impl.rcutils_logger import RcutilsLogger
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from yolov5_lifecycle.ros.console.gate import METRICS, address_of
from yolov5_lifecycle.ros.console.sessions import SESSION_S, Sessions

_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
_PAGE, _LOGIN = "index.html", "login.html"
_MAX_FORM_BYTES = 4096
_MAX_FIELDS = 10
_FORM_S = 10.0
_SESSION_ENDED = 4401

Serve = Callable[[WebSocket], Awaitable[None]]


def page_files() -> dict[str, Response]:
    """All files of the page by name, read once: a request never reaches the file system.

    Raises FileNotFoundError if the installation lacks them.
    """
    folder = files("yolov5_lifecycle.ros.console").joinpath("page")
    kinds = ((file, _TYPES.get(file.name.rpartition(".")[2])) for file in folder.iterdir())
    found = {file.name: Response(file.read_bytes(), media_type=kind) for file, kind in kinds if kind}
    if missing := {_PAGE, _LOGIN} - found.keys():
        raise FileNotFoundError(
            f"{folder} lacks {', '.join(sorted(missing))}: install yolov5_lifecycle again"
        )
    return found


class WebApplication:
    """Serves the files of the page; `page` and `image` serve WebSockets, `figures` gives the metrics' text.

    Without `sessions` there is no login, without `figures` there are no metrics.
    """

    def __init__(
        self,
        page: Serve,
        image: Serve,
        sessions: Sessions | None,
        figures: Callable[[], bytes] | None,
        logger: RcutilsLogger,
    ) -> None:
        self._files = page_files()
        self._sessions = sessions
        self._logger = logger
        routes: list[BaseRoute] = [
            Route("/", lambda _: self._files[_PAGE]),
            Route("/page/{name}", self._file),
            WebSocketRoute("/ws", _within_session(page)),
            WebSocketRoute("/image", _within_session(image)),
        ]
        if sessions is None:
            routes.append(Route("/login", lambda _: _to("/"), methods=["GET", "POST"]))
        else:
            routes.append(Route("/login", lambda _: self._files[_LOGIN], methods=["GET"]))
            routes.append(Route("/login", self._login, methods=["POST"]))
        if figures is not None:
            kind = "text/plain; version=0.0.4; charset=utf-8"
            routes.append(Route(METRICS, lambda _: Response(figures(), media_type=kind)))
        self._starlette = Starlette(routes=routes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._starlette(scope, receive, send)
        except ClientDisconnect:
            pass
        except Exception as error:
            self._logger.error(
                f"unexpected {type(error).__name__} while answering a request: {error}",
                throttle_duration_sec=1.0,
            )
            raise

    def _file(self, request: Request) -> Response:
        if file := self._files.get(request.path_params["name"]):
            return file
        raise HTTPException(404, "page not found")

    async def _login(self, request: Request) -> Response:
        assert self._sessions is not None
        try:
            token = await asyncio.wait_for(_token(request), _FORM_S)
        except asyncio.TimeoutError:
            raise HTTPException(408, "the form did not arrive in time") from None
        is_right = self._sessions.knows_token(token, address_of(request.scope))
        response = _to("/" if is_right else "/login?wrong")
        if is_right:
            response.set_cookie(
                request.state.cookie,
                self._sessions.begin(),
                max_age=int(SESSION_S),
                httponly=True,
                samesite="strict",
                secure=request.state.is_secure,
            )
        return response


def _to(path: str) -> Response:
    return RedirectResponse(path, status_code=303)


def _within_session(serve: Serve) -> Serve:
    """`serve`, ended when the session expires; the page then finds that it has to log in again."""

    async def serve_until_end(websocket: WebSocket) -> None:
        try:
            await asyncio.wait_for(serve(websocket), websocket.state.session_left_s)
        except asyncio.TimeoutError:
            with suppress(RuntimeError):  # it was being closed
                await websocket.close(_SESSION_ENDED, "the session has expired: log in again")

    return serve_until_end


async def _token(request: Request) -> str:
    """The field `token` of the form; raises HTTPException for a form that is too large."""
    content = b""
    async for part in request.stream():
        content += part
        if len(content) > _MAX_FORM_BYTES:
            raise HTTPException(413, f"a form has at most {_MAX_FORM_BYTES} bytes")
    try:
        fields = parse_qs(content.decode("utf-8", "replace"), max_num_fields=_MAX_FIELDS)
    except ValueError:
        raise HTTPException(400, f"a form has at most {_MAX_FIELDS} fields") from None
    return fields.get("token", [""])[0].strip()
