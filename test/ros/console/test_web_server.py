"""Who may see and change what: names, origins, tokens, sessions, limits; with real sockets, without ROS."""

from __future__ import annotations

import asyncio
import http.client
import shutil
import socket
import ssl
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import chain, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest
from rclpy.logging import get_logger
from starlette.responses import PlainTextResponse
from starlette.types import Message, Send
from starlette.websockets import WebSocket
from support.console_process import ConsoleClient, closing_code
from websockets.exceptions import ConnectionClosed, InvalidStatus

from yolov5_lifecycle.ros.console import web_server
from yolov5_lifecycle.ros.console.application import WebApplication
from yolov5_lifecycle.ros.console.gate import Gate
from yolov5_lifecycle.ros.console.images import Viewers
from yolov5_lifecycle.ros.console.options import parsed
from yolov5_lifecycle.ros.console.pages import MAX_PAGES, Find, Pages
from yolov5_lifecycle.ros.console.sessions import SESSION_S, Sessions
from yolov5_lifecycle.ros.console.web_server import (
    MAX_CONNECTIONS,
    MAX_CONNECTIONS_OF_ADDRESS,
    MAX_FRAGMENTS,
    BoundedListener,
    WebServer,
    listening_socket,
)

TOKEN = "t" * 43
FIGURES = "yolov5_state{}"
FOREIGN = "http://evil.example"
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; form-action 'none'; frame-ancestors 'none'; base-uri 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}
NO_NAME = "expected an address or name of this machine, such as"
PATIENCE_S = 60.0
UPGRADE = (
    "GET /ws HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nConnection: Upgrade\r\n"
    "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)
MASK = b"\0\0\0\0"
REQUEST = b'{"type":"collect"}'
BEGIN = b"\x01" + bytes([0x80 | len(REQUEST)]) + MASK + REQUEST
MORE, END = b"\x00\x80" + MASK, b"\x80\x80" + MASK
PING = b"\x89\xfd" + MASK + b"x" * 125


@contextmanager
def serving(
    *words: str, sessions: Sessions | None = None, find: Find = lambda _: None
) -> Iterator[tuple[ConsoleClient, WebServer]]:
    """A browser on this machine, and the web server of a console in this process that knows no detector."""
    options = parsed(["--port", "0", *words])
    sock = listening_socket(options)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 14)  # as its connections will have
    port = sock.getsockname()[1]
    open_pages = Pages(find, list, view_only=options.view_only)
    sessions = sessions or (Sessions(TOKEN) if options.needs_token else None)
    serve = open_pages.serve
    application = WebApplication(serve, serve, sessions, FIGURES.encode, get_logger("console"))
    server = WebServer(Gate(application, options, sessions, port=port), options)
    thread = threading.Thread(target=lambda: asyncio.run(server.serve([sock])))
    thread.start()
    try:
        yield ConsoleClient(f"{options.scheme}://127.0.0.1:{port}/"), server
    finally:
        server.should_exit = True
        thread.join(PATIENCE_S)


@pytest.fixture(scope="module")
def local() -> Iterator[ConsoleClient]:
    """A console for this machine alone, which needs no token."""
    with serving() as (client, _):
        yield client


@pytest.fixture(scope="module")
def guarded() -> Iterator[ConsoleClient]:
    """A console for the network."""
    with serving("--host", "0.0.0.0") as (client, _):
        yield client


def connected(client: ConsoleClient) -> socket.socket:
    """A connection that has said nothing yet."""
    return socket.create_connection(place_of(client), timeout=PATIENCE_S)


def place_of(client: ConsoleClient) -> tuple[str, int]:
    return "127.0.0.1", urlsplit(client.url).port or 0


@pytest.mark.parametrize("path", ["/", "/login", "/page/index.html", "/page/none.js", "/nowhere", "/metrics"])
def test_every_response_forbids_foreign_content(guarded: ConsoleClient, path: str) -> None:
    for headers in ({}, {"Host": "evil.example"}, {"Origin": FOREIGN}):
        reply = guarded.request("GET", path, headers=headers)
        assert {name: reply.headers.get(name) for name in HEADERS} == HEADERS
        assert "access-control-allow-origin" not in reply.headers
        assert "server" not in reply.headers


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        pytest.param("GET", "/", {}, 200, id="page"),
        pytest.param("GET", "/login", {}, 303, id="no login"),
        pytest.param("GET", "/metrics", {}, 200, id="metrics"),
        pytest.param("GET", "/", {"Host": "evil.example"}, 403, id="foreign host"),
        pytest.param("GET", "/", {"Host": ""}, 400, id="no host"),
        pytest.param("GET", "/", {"Origin": FOREIGN}, 403, id="foreign origin"),
        pytest.param("OPTIONS", "/", {"Origin": FOREIGN}, 403, id="preflight"),
        pytest.param("POST", "/login", {}, 403, id="no origin"),
        pytest.param("GET", "/page/..%2fgate.py", {}, 404, id="path out of the folder"),
        pytest.param("GET", "/" + "a" * 30_000, {}, 431, id="long path"),
        pytest.param("GET", "/", {"Cookie": "console=" + "a" * 30_000}, 431, id="long cookie"),
        pytest.param("GET", "/", {"Cookie": "console=\x01; ;;=; $x"}, 200, id="broken cookie"),
        pytest.param("GET", "/ws", {}, 404, id="socket without upgrade"),
    ],
)
def test_a_request_on_loopback_is_answered_with(
    local: ConsoleClient, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    assert local.request(method, path, headers=headers).status == status


@pytest.mark.parametrize(
    ("headers", "body"),
    [
        pytest.param({"Transfer-Encoding": "chunked"}, "0\r\n\r\n", id="two lengths"),
        pytest.param({"Content-Length": "1000000"}, None, id="body that does not come"),
        pytest.param({}, "token=a", id="form"),
    ],
)
def test_a_request_with_a_body_is_refused_and_its_connection_closed(
    local: ConsoleClient, headers: dict[str, str], body: str | None
) -> None:
    reply = local.request("POST", "/login", headers={"Origin": local.origin} | headers, body=body)
    assert (reply.status, reply.headers.get("connection")) == (400, "close")


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        pytest.param("/ws", {"Origin": FOREIGN}, 403, id="foreign origin"),
        pytest.param("/image?node=/yolov5", {"Origin": ""}, 403, id="no origin"),
        pytest.param("/nowhere", {}, 403, id="unknown socket"),
        pytest.param("/ws", {f"X-{number}": "a" for number in range(200)}, 400, id="many headers"),
    ],
)
def test_a_socket_is_refused(local: ConsoleClient, path: str, headers: dict[str, str], status: int) -> None:
    assert refused_status(local, path, headers) == status


def refused_status(client: ConsoleClient, path: str, headers: dict[str, str]) -> int:
    with pytest.raises(InvalidStatus) as refusal:
        client.socket(path, headers=headers)
    return refusal.value.response.status_code


@pytest.mark.parametrize(
    "request_text",
    [
        pytest.param(UPGRADE.replace("{host}", "evil.example:{port}"), id="socket of a rebound name"),
        pytest.param(
            "GET / HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nOrigin: http://evil.example\r\n\r\n",
            id="two origins",
        ),
    ],
)
def test_a_request_that_no_browser_sends_for_the_page_is_refused(
    local: ConsoleClient, request_text: str
) -> None:
    port = place_of(local)[1]
    with connected(local) as connection:
        connection.sendall(request_text.format(host=f"127.0.0.1:{port}", port=port).encode())
        assert b" 403 " in connection.recv(4096).partition(b"\r\n")[0]


@pytest.mark.parametrize("cookie", ["", "{name}=", "{name}=" + TOKEN], ids=["none", "empty", "token"])
def test_without_a_session_nothing_is_shown(guarded: ConsoleClient, cookie: str) -> None:
    headers = {"Cookie": cookie.format(name=guarded.cookie_name)}
    for path in ("/ws", "/image?node=/yolov5&camera="):
        assert refused_status(guarded, path, headers) == 401
    reply = guarded.request("GET", "/", headers=headers)
    assert (reply.status, reply.headers["location"]) == (303, "/login")
    assert "<noscript>" in guarded.request("GET", "/login").body, "what a browser without scripts needs"


def test_the_token_begins_a_session_whose_cookie_scripts_and_other_pages_do_not_get(
    guarded: ConsoleClient,
) -> None:
    reply = guarded.log_in(TOKEN)
    cookie, *attributes = reply.headers["set-cookie"].split("; ")
    assert cookie.startswith(f"{guarded.cookie_name}=")
    assert TOKEN not in cookie
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(attributes)
    assert "Secure" not in attributes
    browser = guarded.logged_in(TOKEN)
    assert browser.request("GET", "/").status == 200
    assert guarded.request("GET", "/metrics", headers={"Authorization": f"Bearer {TOKEN}"}).body == FIGURES
    odd = f"{browser.cookie_name}=stale; k=hello world; {browser.cookie}; k={'a' * 10_000}"
    with ConsoleClient(browser.url, odd).page() as page:
        assert page.welcome["type"] == "welcome"


def test_an_open_socket_is_closed_when_its_session_expires() -> None:
    now_s = 0.0
    sessions = Sessions(TOKEN, clock=lambda: now_s)
    with serving("--host", "0.0.0.0", sessions=sessions) as (client, _):
        browser = client.logged_in(TOKEN)
        now_s = SESSION_S - 0.1
        with browser.page() as page:
            assert closing_code(page.connection) == 4401
        now_s = SESSION_S
        assert browser.request("GET", "/").status == 303


def test_behind_a_proxy_with_tls_the_cookie_is_for_tls_alone_and_wrong_tokens_are_throttled() -> None:
    with serving("--public-url", "https://robot.example") as (client, _):
        reply = client.log_in(TOKEN, Host="robot.example", Origin="https://robot.example")
        cookie, *attributes = reply.headers["set-cookie"].split("; ")
        assert cookie.startswith(f"__Host-{client.cookie_name}=")
        assert {"Secure", "Path=/"} <= set(attributes)
        assert not any(attribute.lower().startswith("domain") for attribute in attributes)
        assert reply.headers["strict-transport-security"] == "max-age=2592000"
        assert "strict-transport-security" not in client.request("GET", "/login").headers
        page = {"Host": "robot.example", "Cookie": f"k=hello world; {cookie}"}
        assert client.request("GET", "/", headers=page).status == 200
        assert client.log_in(TOKEN, Host="robot.example", Origin="http://robot.example").status == 403
        replies = [client.log_in(f"wrong {number}") for number in range(6)]
        assert [reply.status for reply in replies] == [401] * 5 + [429]
        assert {reply.body for reply in replies[:5]} == {"This is not the token of this console."}
        assert not any("set-cookie" in reply.headers for reply in replies)
        assert client.logged_in(TOKEN).request("GET", "/").status == 200


@pytest.mark.parametrize(
    "words", ["", "Bearer ", f"Basic {TOKEN}", "Bearer \xff\xfe", f"Bearer {'a' * 5000}"]
)
def test_without_the_token_there_are_neither_sessions_nor_metrics(guarded: ConsoleClient, words: str) -> None:
    headers = {"Origin": guarded.origin, "Authorization": words}
    login = guarded.request("POST", "/login", headers=headers)
    assert (login.status, login.headers.get("set-cookie")) == (401, None)
    metrics = guarded.request("GET", "/metrics", headers=headers)
    assert (metrics.status, metrics.headers["www-authenticate"]) == (401, "Bearer")


def test_for_viewing_only_nothing_is_changed() -> None:
    with serving("--view-only") as (client, _), client.page() as page:
        assert page.welcome["view_only"]
        assert "--view-only" in page.set(confidence_threshold=0.9)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        pytest.param("{", "JSON", id="half"),
        pytest.param("[]", "JSON", id="list"),
        pytest.param("[" * 100_000, "JSON", id="nested"),
        pytest.param('{"type":"set","values":{"max_rate":NaN}}', "JSON", id="NaN"),
        pytest.param('{"type":"reboot"}', "expected the type set", id="type"),
        pytest.param('{"type":"set"}', "an object of 1 to", id="no values"),
        pytest.param('{"type":"set","node":"/yolov5","values":{}}', "an object of 1 to", id="empty"),
        pytest.param('{"type":"transition","node":"/yolov5","label":7}', "with a label", id="label"),
        pytest.param('{"type":"transition","label":"configure"}', "no detector None", id="no node"),
        pytest.param('{"type":"transition","node":["/x"],"label":"configure"}', "no detector", id="node"),
    ],
)  # fmt: skip
def test_a_message_that_is_no_request_is_answered(local: ConsoleClient, message: str, words: str) -> None:
    with local.page() as page:
        page.connection.send(message)
        page.wait_for(lambda: None in page.answers, "an answer")
        assert not page.answers[None]["ok"]
        assert words in page.answers[None]["reason"]


@pytest.mark.parametrize(
    ("content", "code"),
    [
        pytest.param(["x" * (1 << 20)], 1009, id="too large"),
        pytest.param(['{"type":"set"}'] * 1000, 1008, id="too many"),
        pytest.param([b"\xff\xfe"], 1007, id="no text"),
    ],
)
def test_messages_beyond_bounds_close_their_connection_and_no_other(
    local: ConsoleClient, content: list[str | bytes], code: int
) -> None:
    with local.page() as calm, local.page() as page:
        with suppress(ConnectionClosed):
            for message in content:
                page.connection.send(message, text=True)
        assert closing_code(page.connection) == code
        assert "no detector" in calm.transition("configure")


def test_too_many_pages_are_refused(local: ConsoleClient) -> None:
    with ExitStack() as stack:
        for _ in range(MAX_PAGES):
            assert stack.enter_context(local.page()).welcome["type"] == "welcome"
        with local.socket("/ws") as late:
            assert closing_code(late) == 1013


def websocket_of(texts: Iterator[str], send: Send) -> WebSocket:
    """The server's end of a WebSocket on which `texts` come."""
    heard: Iterator[Message] = ({"type": "websocket.receive", "text": text} for text in texts)
    messages = chain([{"type": "websocket.connect"}], heard)

    async def receive() -> Message:
        await asyncio.sleep(0)
        return next(messages)

    return WebSocket({"type": "websocket", "query_string": b""}, receive, send)


@pytest.mark.parametrize("serve", ["page", "image"])
def test_a_client_that_is_refused_once_it_has_gone_is_no_error(serve: str) -> None:
    async def send(message: Message) -> None:
        if message["type"] != "websocket.accept":
            raise OSError("gone")

    ros: Any = SimpleNamespace(run=lambda *_: None, node=None)
    detector: Any = SimpleNamespace(cameras={"": None})
    pages, viewers = Pages(lambda _: None, list, view_only=False), Viewers(ros, lambda _: detector)
    asyncio.run((pages if serve == "page" else viewers).serve(websocket_of(repeat("more", 100), send)))
    assert viewers.count == 0


def test_a_page_that_reads_no_answers_is_not_read_from_either() -> None:
    texts = iter(["{}"] * 50)

    async def send(message: Message) -> None:
        if message["type"] == "websocket.send":
            await asyncio.Event().wait()

    async def serve() -> None:
        page = Pages(lambda _: None, list, view_only=False).serve(websocket_of(texts, send))
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(page, 0.2)

    asyncio.run(serve())
    assert len(list(texts)) == 49


@contextmanager
def upgraded() -> Iterator[tuple[socket.socket, WebServer, threading.Event]]:
    """A WebSocket as bare bytes, of which the kernel keeps little, and what is set once it was heard."""
    heard = threading.Event()
    with serving(find=lambda _: heard.set()) as (client, server), socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 12)
        connection.settimeout(PATIENCE_S)
        connection.connect(place_of(client))
        connection.sendall(UPGRADE.format(host=f"127.0.0.1:{place_of(client)[1]}").encode())
        while b"welcome" not in connection.recv(4096):
            pass
        yield connection, server, heard


def test_a_message_of_many_fragments_is_heard() -> None:
    with upgraded() as (connection, _, heard):
        connection.sendall(BEGIN + MORE * (MAX_FRAGMENTS - 2) + END)
        assert heard.wait(PATIENCE_S)


@pytest.mark.parametrize("excess", [1, 5000], ids=["one too many", "thousands too many"])
def test_a_message_that_does_not_end_closes_its_connection(excess: int) -> None:
    with upgraded() as (connection, *_), suppress(ConnectionResetError):
        connection.sendall(BEGIN + MORE * (MAX_FRAGMENTS - 1 + excess))
        assert b"more than %d fragments of a message" % MAX_FRAGMENTS in connection.recv(4096)


def test_pings_of_a_client_that_reads_no_pongs_are_not_kept() -> None:
    count = 24_000
    with upgraded() as (connection, server, heard):
        (kept,) = server.server_state.connections
        connection.sendall(PING * count + BEGIN + END)
        assert heard.wait(PATIENCE_S)
        assert kept.transport.get_write_buffer_size() < len(PING) * count / 2


def test_connections_that_never_read_or_say_nothing_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "_REQUEST_S", 0.2)
    monkeypatch.setattr(web_server, "_UNREAD_S", 0.2)
    with serving() as (client, _):
        request = f"GET /page/main.js HTTP/1.1\r\nHost: 127.0.0.1:{place_of(client)[1]}\r\n\r\n".encode()
        with connected(client) as silent, socket.socket() as deaf:
            silent.sendall(request[:20])
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            deaf.settimeout(PATIENCE_S)
            deaf.connect(place_of(client))
            with pytest.raises(OSError, match=r"reset|[Bb]roken"):
                send_forever(deaf, request)
            with suppress(ConnectionResetError):
                assert silent.recv(1) == b""


def send_forever(connection: socket.socket, request: bytes) -> None:
    while True:
        connection.sendall(request * 100)


def test_one_address_and_all_together_get_no_more_connections_than_their_share() -> None:
    with ExitStack() as stack:
        listener = stack.enter_context(BoundedListener(socket.create_server(("127.0.0.1", 0))))
        accepted: list[socket.socket] = []

        def is_accepted(number: int) -> bool:
            source = (f"127.0.0.{number}", 0)
            stack.enter_context(socket.create_connection(listener.getsockname(), source_address=source))
            with suppress(ConnectionAbortedError):
                accepted.append(stack.enter_context(listener.accept()[0]))
                return True
            return False

        wanted = [is_accepted(1) for _ in range(MAX_CONNECTIONS_OF_ADDRESS + 3)]
        assert wanted == [True] * MAX_CONNECTIONS_OF_ADDRESS + [False] * 3
        accepted[0].close()
        assert is_accepted(1)
        others = [is_accepted(number + 2) for number in range(MAX_CONNECTIONS_OF_ADDRESS + 1)]
        assert others == [True] * (MAX_CONNECTIONS - MAX_CONNECTIONS_OF_ADDRESS) + [False]


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="no IPv6")
@pytest.mark.parametrize("address", ["127.0.0.1", "::1"])
def test_all_addresses_of_ipv6_include_those_of_ipv4(address: str) -> None:
    with (
        listening_socket(parsed(["--host", "::", "--port", "0"])) as listener,
        socket.create_connection((address, listener.getsockname()[1]), timeout=PATIENCE_S),
    ):
        listener.accept()[0].close()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        pytest.param(["--host", "no such host"], NO_NAME, id="name with gaps"),
        pytest.param(["--host", "lamp\u202e"], NO_NAME, id="name with a mark"),
        pytest.param(["--host", f"{'a' * 64}.local"], NO_NAME, id="long name"),
        pytest.param(["--host", "192.0.2.1"], "not an address of this machine; 0.0.0.0", id="address"),
        pytest.param(["--cert", "/none", "--key", "/none"], "Expected a certificate chain and", id="files"),
    ],
)
def test_what_cannot_be_used_is_refused_with_what_is_expected(words: list[str], told: str) -> None:
    options = parsed(["--port", "0", *words])
    with pytest.raises(OSError, match=told), listening_socket(options):
        WebServer(PlainTextResponse(), options)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_with_a_certificate_it_speaks_tls(tmp_path: Path) -> None:
    files = ["--cert", str(tmp_path / "robot.pem"), "--key", str(tmp_path / "robot.key")]
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"]
    words = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *names]
    subprocess.run([*words, "-out", files[1], "-keyout", files[3]], check=True, capture_output=True)
    context = ssl.create_default_context(cafile=files[1])
    with serving(*files) as (client, _):
        page = http.client.HTTPSConnection(*place_of(client), context=context, timeout=PATIENCE_S)
        with closing(page):
            page.request("GET", "/")
            response = page.getresponse()
            assert response.status == 200
            assert response.headers["strict-transport-security"]
