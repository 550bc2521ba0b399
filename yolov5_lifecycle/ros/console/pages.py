"""The WebSocket over which a page receives the state of nodes and changes it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.frames import CloseCode

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.console.detector import Detector
from yolov5_lifecycle.ros.console.sessions import Budget

MAX_PAGES = 16
VIEW_ONLY = "this console is for viewing only (--view-only)"
_MESSAGES_PER_S = 30.0
_MESSAGES = 60
_MAX_PENDING = 8
"""Requests of a page that are not answered yet, or whose answers it has not read."""
_MAX_VALUES = 400
_UPDATE_S = 0.25
_EXPECTED = (
    f"expected the type set with values, an object of 1 to {_MAX_VALUES} parameters, the type transition "
    "with a label, or the type collect"
)

Find = Callable[[object], Detector | None]


class Pages:
    """All open pages; each node is sent at most four times a second, as one text that all pages share.

    `find` returns the detector with a name, `known` all detectors.
    """

    def __init__(self, find: Find, known: Callable[[], Iterable[Detector]], *, view_only: bool) -> None:
        self._find = find
        self._known = known
        self._view_only = view_only
        self._open: set[_Page] = set()
        self._changed: set[str] = set()
        self._timer: asyncio.TimerHandle | None = None

    def changed(self, detector: Detector) -> None:
        """Send the detector to all pages soon."""
        self._changed.add(detector.name)
        if self._timer is None:
            self._send_changed()

    def gone(self, detector: Detector) -> None:
        """Notify all pages that the detector is gone, with what was last known of it."""
        self._show(detector.name, {"type": "gone", "node": detector.as_json()})

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one page until it is closed."""
        await websocket.accept()
        if len(self._open) >= MAX_PAGES:
            await websocket.close(CloseCode.TRY_AGAIN_LATER, f"close a page: {MAX_PAGES} are open, the limit")
            return
        page = _Page(websocket, self._find, view_only=self._view_only)
        self._open.add(page)
        try:
            await page.serve({detector.name: json.dumps(_node(detector)) for detector in self._known()})
        finally:
            self._open.discard(page)

    def _send_changed(self) -> None:
        self._timer = None
        if self._changed and self._open:
            self._timer = asyncio.get_running_loop().call_later(_UPDATE_S, self._send_changed)
            for detector in filter(None, map(self._find, self._changed)):
                self._show(detector.name, _node(detector))
        self._changed.clear()

    def _show(self, name: str, message: dict[str, object]) -> None:
        text = json.dumps(message) if self._open else ""
        for page in self._open:
            page.show(name, text)


class _Page:
    """One open page. Only the newest text of each node waits to be sent."""

    def __init__(self, websocket: WebSocket, find: Find, *, view_only: bool) -> None:
        self._websocket = websocket
        self._find = find
        self._view_only = view_only
        self._nodes: dict[str, str] = {}
        self._news = asyncio.Event()
        self._budget = Budget(_MESSAGES_PER_S, _MESSAGES)
        self._requests: set[asyncio.Task[None]] = set()

    def show(self, name: str, text: str) -> None:
        self._nodes[name] = text
        self._news.set()

    async def serve(self, nodes: dict[str, str]) -> None:
        self._nodes.update(nodes)
        self._news.set()
        sender = asyncio.create_task(self._send_nodes(list(nodes)))
        try:
            await self._receive()
        finally:
            sender.cancel()
            # Requests in progress continue: the detector carries them out, with or without the page.

    async def _send_nodes(self, names: list[str]) -> None:
        await self._send(json.dumps({"type": "welcome", "view_only": self._view_only, "nodes": names}))
        while await self._news.wait():
            self._news.clear()
            while self._nodes:
                await self._send(self._nodes.pop(next(iter(self._nodes))))

    async def _send(self, text: str) -> None:
        """Returns once the client has taken most of what was sent; of a closed one, `_receive` ends, too."""
        with suppress(WebSocketDisconnect, RuntimeError):
            await self._websocket.send_text(text)

    async def _receive(self) -> None:
        while (message := await self._websocket.receive())["type"] != "websocket.disconnect":
            if not self._budget.spend():
                with suppress(WebSocketDisconnect, RuntimeError):  # it is gone
                    await self._websocket.close(CloseCode.POLICY_VIOLATION, "too many messages")
                return
            await self._handle(message.get("text"))

    async def _handle(self, text: str | None) -> None:
        request, problem = _request(text)
        if not problem and self._view_only:
            problem = VIEW_ONLY
        if not problem and len(self._requests) >= _MAX_PENDING:
            problem = f"{_MAX_PENDING} requests of this page are not answered yet: wait for them"
        detector = None if problem else self._find(request.get("node"))
        if not problem and detector is None:
            problem = f"there is no detector {in_one_line(str(request.get('node')), 100)}"
        if problem or detector is None:
            await self._answer(request.get("id"), problem)
            return
        task = asyncio.create_task(self._do(detector, request))
        self._requests.add(task)
        task.add_done_callback(self._requests.discard)

    async def _do(self, detector: Detector, request: dict[str, Any]) -> None:
        reason = result = ""
        if request["type"] == "set":
            reason = await detector.set(request["values"])
        elif request["type"] == "transition":
            reason = await detector.change_state(request["label"])
        else:
            reason, result = await detector.collect()
        await self._answer(request.get("id"), reason, result)

    async def _answer(self, request_id: object, reason: str, result: str = "") -> None:
        is_id = isinstance(request_id, (int, str)) and len(str(request_id)) <= 100
        answer = {"type": "answer", "id": request_id if is_id else None, "ok": not reason, "reason": reason}
        await self._send(json.dumps(answer | {"result": result}))


def _node(detector: Detector) -> dict[str, object]:
    return {"type": "node", "node": detector.as_json()}


def _request(text: str | None) -> tuple[dict[str, Any], str]:
    """The request in a message, and why it is invalid, "" if it is valid."""
    try:
        request = json.loads(text or "", parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        return {}, "expected a JSON object"
    match request:
        case {"type": "set", "values": dict(values)} if 0 < len(values) <= _MAX_VALUES:
            return request, ""
        case {"type": "transition", "label": str()} | {"type": "collect"}:
            return request, ""
        case dict():
            return request, _EXPECTED
    return {}, "expected a JSON object"


def _refuse_constant(name: str) -> object:
    raise ValueError(f"{name} is not JSON")
