"""The web application: the page, its two kinds of WebSockets, login and metrics."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from urllib.parse import parse_qs

from rclpy.impl.rcutils_logger import RcutilsLogger
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from yolov5_lifecycle.ros.console.gate import METRICS, address_of
from yolov5_lifecycle.ros.console.page_files import LOGIN, PAGE, PageFile
from yolov5_lifecycle.ros.console.sessions import SESSION_S, Sessions, TooManyTriesError

_MAX_FORM_BYTES = 4096
_MAX_FIELDS = 10
_FORM_S = 10.0
_SESSION_ENDED = 4401

Serve = Callable[[WebSocket], Awaitable[None]]
Figures = Callable[[], bytes]


class WebApplication:
    """Serves `files`; `page` and `image` serve the WebSockets, `figures` creates the text of the metrics.

    Without `sessions` there is no login, without `figures` there are no metrics.
    """

    def __init__(
        self,
        files: dict[str, PageFile],
        *,
        page: Serve,
        image: Serve,
        sessions: Sessions | None,
        figures: Figures | None,
        logger: RcutilsLogger,
    ) -> None:
        self._files = files
        self._sessions = sessions
        self._figures = figures
        self._logger = logger
        routes: list[BaseRoute] = [
            Route("/", lambda _: self._file(PAGE)),
            Route("/login", self._login_page, methods=["GET"]),
            Route("/login", self._login, methods=["POST"]),
            Route("/page/{name}", lambda request: self._file(request.path_params["name"])),
            WebSocketRoute("/ws", _within_session(page)),
            WebSocketRoute("/image", _within_session(image)),
        ]
        if figures is not None:
            routes.append(Route(METRICS, self._metrics))
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

    def _file(self, name: str) -> Response:
        file = self._files.get(name)
        if file is None:
            raise HTTPException(404, "page not found")
        return Response(file.content, media_type=file.media_type)

    async def _login_page(self, _: Request) -> Response:
        return self._file(LOGIN) if self._sessions else RedirectResponse("/", status_code=303)

    async def _login(self, request: Request) -> Response:
        if self._sessions is None:
            return RedirectResponse("/", status_code=303)
        try:
            token = await asyncio.wait_for(_token(request), _FORM_S)
            is_right = self._sessions.knows_token(token, address_of(request.scope))
        except asyncio.TimeoutError:
            return PlainTextResponse("the form did not arrive in time\n", status_code=408)
        except TooManyTriesError:
            text = "too many wrong tokens: wait a minute\n"
            return PlainTextResponse(text, status_code=429, headers={"Retry-After": "60"})
        if not is_right:
            return RedirectResponse("/login?wrong", status_code=303)
        response = RedirectResponse("/", status_code=303)
        response.set_cookie(
            request.state.cookie,
            self._sessions.begin(),
            max_age=int(SESSION_S),
            httponly=True,
            samesite="strict",
            secure=bool(request.state.is_secure),
        )
        return response

    def _metrics(self, _: Request) -> Response:
        assert self._figures is not None
        return Response(self._figures(), media_type="text/plain; version=0.0.4; charset=utf-8")


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
