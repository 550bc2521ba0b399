"""Who may see and change what: names, origins, tokens, limits."""

from __future__ import annotations

import http.client
import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support.console_fixtures import ConsoleBesideNode, console_beside_node
from support.console_process import ConsoleClient, Page, address, console_process
from support.detector_process import NODE
from websockets.exceptions import ConnectionClosed, InvalidStatus

FOREIGN = "http://evil.example"
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cache-control": "no-store",
}
_TOKEN = re.compile(r"token: (\S+)")


@pytest.fixture(scope="module")
def console() -> Iterator[ConsoleBesideNode]:
    """A console for this machine alone, which needs no token."""
    with console_beside_node("--metrics") as beside:
        yield beside


@pytest.fixture(scope="module")
def token_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("token") / "token"


@pytest.fixture(scope="module")
def guarded(console: ConsoleBesideNode, token_file: Path) -> Iterator[ConsoleClient]:
    """A console for the network, as a browser on this machine sees it."""
    words = ["--host", "0.0.0.0", "--metrics", "--token-file", str(token_file)]
    with console_process(console.domain, *words) as process:
        found = _TOKEN.search(process.output)
        assert found
        assert found[1] == token_file.read_text().strip()
        assert process.output.count(found[1]) == 1
        yield ConsoleClient(f"http://127.0.0.1:{urlsplit(address(process)).port}/")
        process.check_running()
        assert "Traceback" not in process.output


@pytest.fixture(scope="module")
def token(guarded: ConsoleClient, token_file: Path) -> str:
    return token_file.read_text().strip()


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
        pytest.param("GET", "/", {"Origin": "null"}, 403, id="origin null"),
        pytest.param("OPTIONS", "/", {"Origin": FOREIGN}, 403, id="preflight"),
        pytest.param("POST", "/login", {}, 403, id="no origin"),
        pytest.param("GET", "/page/..%2fprocess.py", {}, 404, id="escaped path"),
        pytest.param("GET", "/page/../process.py", {}, 404, id="path"),
        pytest.param("GET", "/page/process.py", {}, 404, id="no page file"),
        pytest.param("DELETE", "/metrics", {}, 403, id="delete"),
        pytest.param("GET", "/" + "a" * 30_000, {}, 431, id="long path"),
        pytest.param("GET", "/", {"Cookie": "console=" + "a" * 30_000}, 431, id="long cookie"),
        pytest.param("GET", "/", {"Cookie": "console=\x01; ;;=; $x"}, 200, id="broken cookie"),
        pytest.param("GET", "/ws", {}, 404, id="socket without upgrade"),
    ],
)
def test_a_request_on_loopback_is_answered_with(
    console: ConsoleBesideNode, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    assert console.client.request(method, path, headers=headers).status == status


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        pytest.param("/ws", {"Origin": FOREIGN}, 403, id="foreign origin"),
        pytest.param("/ws", {"Origin": ""}, 403, id="no origin"),
        pytest.param("/image?node=/yolov5", {"Origin": FOREIGN}, 403, id="image of a foreign origin"),
        pytest.param("/nowhere", {}, 403, id="unknown socket"),
        pytest.param("/ws", {f"X-{number}": "a" for number in range(200)}, 400, id="many headers"),
    ],
)
def test_a_socket_is_refused(
    console: ConsoleBesideNode, path: str, headers: dict[str, str], status: int
) -> None:
    with pytest.raises(InvalidStatus) as refusal:
        console.client.socket(path, headers=headers)
    assert refusal.value.response.status_code == status


def test_a_socket_of_a_foreign_host_is_refused(console: ConsoleBesideNode) -> None:
    host, port = urlsplit(console.client.url).hostname, urlsplit(console.client.url).port
    rebound = f"evil.example:{port}"
    with socket.create_connection((host, port), timeout=60) as connection:
        connection.sendall(
            f"GET /ws HTTP/1.1\r\nHost: {rebound}\r\nOrigin: http://{rebound}\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: "
            "AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
        )
        assert b" 403 " in connection.recv(4096).partition(b"\r\n")[0]


@pytest.mark.parametrize("path", ["/ws", "/image?node=/yolov5&camera="])
@pytest.mark.parametrize(
    "cookie", ["", "{name}=", "{name}=wrong", "other=1"], ids=["none", "empty", "wrong", "other"]
)
def test_without_a_session_nothing_is_shown(guarded: ConsoleClient, path: str, cookie: str) -> None:
    cookie = cookie.format(name=guarded.cookie_name)
    with pytest.raises(InvalidStatus) as refusal:
        guarded.socket(path, headers={"Cookie": cookie})
    assert refusal.value.response.status_code == 401
    reply = guarded.request("GET", "/", headers={"Cookie": cookie})
    assert (reply.status, reply.headers["location"]) == (303, "/login")


def test_the_token_is_no_session(guarded: ConsoleClient, token: str) -> None:
    with pytest.raises(InvalidStatus):
        guarded.socket("/ws", headers={"Cookie": f"{guarded.cookie_name}={token}"})


def test_the_token_begins_a_session_whose_cookie_scripts_and_other_pages_do_not_get(
    guarded: ConsoleClient, token: str
) -> None:
    reply = guarded.log_in(token)
    assert (reply.status, reply.headers["location"]) == (303, "/")
    cookie, *attributes = reply.headers["set-cookie"].split("; ")
    assert cookie.startswith(f"{guarded.cookie_name}=")
    assert token not in cookie
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(attributes)
    assert "Secure" not in attributes
    browser = guarded.logged_in(token)
    assert browser.request("GET", "/").status == 200
    with browser.page() as page:
        page.wait_for(lambda: NODE in page.nodes, "the detector")


@pytest.mark.parametrize("odd", ['prefs={"a":1}', "k=hello world", "k=" + "a" * 10_000], ids=len)
def test_cookies_of_other_programs_on_the_host_end_no_session(
    guarded: ConsoleClient, token: str, odd: str
) -> None:
    browser = guarded.logged_in(token)
    stale = f"{guarded.cookie_name}=stale"
    for cookies in (
        f"{odd}; {browser.cookie}",
        f"{browser.cookie}; {odd}",
        f"{stale}; {browser.cookie}; {stale}",
    ):
        assert browser.request("GET", "/", headers={"Cookie": cookies}).status == 200
        with ConsoleClient(browser.url, cookies).page() as page:
            assert page.welcome["type"] == "welcome"


def test_a_length_that_is_told_twice_is_refused(console: ConsoleBesideNode) -> None:
    client = console.client
    headers = {"Origin": client.origin, "Transfer-Encoding": "chunked"}
    reply = client.request("POST", "/login", headers=headers, body="0\r\n\r\n")
    assert (reply.status, reply.headers.get("connection")) == (400, "close")


@pytest.mark.long
def test_connections_that_never_read_are_closed(console: ConsoleBesideNode) -> None:
    target = (urlsplit(console.client.url).hostname, urlsplit(console.client.url).port)
    request = f"GET /page/main.js HTTP/1.1\r\nHost: {target[0]}:{target[1]}\r\n\r\n".encode()
    with socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect(target)
        deaf.settimeout(60)
        with pytest.raises(OSError, match=r"reset|[Bb]roken"):
            send_forever(deaf, request)


def send_forever(connection: socket.socket, request: bytes) -> None:
    while True:
        connection.sendall(request * 100)


@pytest.mark.long
def test_a_session_of_another_console_on_this_host_ends_none(
    console: ConsoleBesideNode, guarded: ConsoleClient, token: str, token_file: Path
) -> None:
    words = ["--host", "0.0.0.0", "--token-file", str(token_file)]
    with console_process(console.domain, *words) as process:
        other = ConsoleClient(f"http://127.0.0.1:{urlsplit(address(process)).port}/")
        # A browser keeps one value for each name, and sends it to every port.
        kept = dict(client.logged_in(token).cookie.split("=", 1) for client in (guarded, other))
        cookies = "; ".join(f"{name}={value}" for name, value in kept.items())
        for client in (guarded, other):
            assert client.request("GET", "/", headers={"Cookie": cookies}).status == 200


def test_a_wrong_token_begins_none_and_is_throttled(console: ConsoleBesideNode, tmp_path: Path) -> None:
    words = ["--public-url", "https://robot.example", "--token-file", str(tmp_path / "token")]
    with console_process(console.domain, *words) as process:
        client = ConsoleClient(address(process))
        replies = [client.log_in(f"wrong {number}") for number in range(6)]
        assert [reply.status for reply in replies] == [303] * 5 + [429]
        assert {reply.headers.get("location") for reply in replies[:5]} == {"/login?wrong"}
        assert not any("set-cookie" in reply.headers for reply in replies)
        assert client.logged_in((tmp_path / "token").read_text().strip()).request("GET", "/").status == 200


@pytest.mark.long
def test_behind_a_proxy_with_tls_the_cookie_is_for_tls_alone(
    console: ConsoleBesideNode, tmp_path: Path
) -> None:
    words = ["--public-url", "https://robot.example", "--token-file", str(tmp_path / "token")]
    with console_process(console.domain, *words) as process:
        client = ConsoleClient(address(process))
        token = (tmp_path / "token").read_text().strip()
        reply = client.log_in(token, Host="robot.example", Origin="https://robot.example")
        assert reply.status == 303
        cookie, *attributes = reply.headers["set-cookie"].split("; ")
        assert cookie.startswith(f"__Host-{client.cookie_name}=")
        assert {"Secure", "Path=/"} <= set(attributes)
        assert not any(attribute.lower().startswith("domain") for attribute in attributes)
        assert reply.headers["strict-transport-security"] == "max-age=2592000"
        assert "strict-transport-security" not in client.request("GET", "/login").headers
        page = {"Host": "robot.example", "Cookie": f"k=hello world; {cookie}"}
        assert client.request("GET", "/", headers=page).status == 200
        refused = client.log_in(token, Host="robot.example", Origin="http://robot.example")
        assert refused.status == 403


@pytest.mark.parametrize(
    ("body", "status"),
    [
        pytest.param("", 303, id="empty"),
        pytest.param("token=%ff%fe", 303, id="no text"),
        pytest.param("&".join(["token=a"] * 100), 400, id="many fields"),
        pytest.param("token=" + "a" * 5000, 413, id="large"),
    ],
)
def test_a_form_that_has_no_token_is_answered(guarded: ConsoleClient, body: str, status: int) -> None:
    reply = guarded.request("POST", "/login", headers={"Origin": guarded.origin}, body=body)
    assert reply.status in (status, 429)


def test_metrics_need_the_token_on_a_network(guarded: ConsoleClient, token: str) -> None:
    assert guarded.request("GET", "/metrics").status == 401
    with guarded.logged_in(token).page() as page:
        page.wait_for_state("unconfigured")
    reply = guarded.request("GET", "/metrics", headers={"Authorization": f"Bearer {token}"})
    assert reply.status == 200
    assert "yolov5_state{" in reply.body


def test_metrics_are_off_unless_asked_for(console: ConsoleBesideNode) -> None:
    with console_process(console.domain) as process:
        assert ConsoleClient(address(process)).request("GET", "/metrics").status == 404


def test_metrics_have_the_figures_of_the_diagnostics(console: ConsoleBesideNode) -> None:
    with console.client.page() as page:
        page.wait_for(lambda: NODE in page.nodes, "the detector")
    text = console.client.request("GET", "/metrics").body
    assert f'yolov5_state{{node="{NODE}",state="unconfigured"}} 1.0' in text
    assert f'yolov5_frames_total{{camera="",node="{NODE}",outcome="detected"}} 0.0' in text
    assert "yolov5_resident_memory_megabytes{" in text


@pytest.mark.long
def test_view_only_shows_all_and_changes_nothing(console: ConsoleBesideNode) -> None:
    with (
        console_process(console.domain, "--view-only") as process,
        ConsoleClient(address(process)).page() as page,
    ):
        assert page.welcome["view_only"]
        page.wait_for(lambda: NODE in page.nodes, "the detector")
        refusals = page.set(confidence_threshold=0.9), page.transition("configure"), page.ask(type="collect")
        for refusal in refusals:
            assert "--view-only" in refusal
    assert console.served.get("confidence_threshold") == 0.25
    assert console.served.state() == "unconfigured"


def test_too_large_a_message_closes_the_connection(console: ConsoleBesideNode) -> None:
    with console.client.page() as page, pytest.raises(ConnectionClosed) as closed:
        send_much(page)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1009


def send_much(page: Page) -> None:
    """Send a megabyte and wait; the connection may be closed before all of it is sent."""
    page.connection.send("x" * (1 << 20))
    page.wait_for(lambda: False, "the end")


def test_a_flood_closes_its_connection_and_no_other(console: ConsoleBesideNode) -> None:
    with console.client.page() as calm, console.client.page() as flooding:
        calm.wait_for(lambda: NODE in calm.nodes, "the detector")
        with pytest.raises(ConnectionClosed) as closed:
            flood(flooding)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1008
        assert calm.set(iou_threshold=0.45) == ""


def flood(page: Page) -> None:
    """Send until the connection is closed."""
    for _ in range(10_000):
        page.connection.send('{"type":"set"}')
    page.wait_for(lambda: False, "the end")


def test_bytes_that_are_no_text_close_the_connection(console: ConsoleBesideNode) -> None:
    with console.client.page() as page:
        page.connection.send(b"\xff\xfe", text=True)
        with pytest.raises(ConnectionClosed):
            page.wait_for(lambda: False, "the end")


def test_too_many_pages_are_refused(console: ConsoleBesideNode) -> None:
    with ExitStack() as stack:
        for _ in range(16):
            page = stack.enter_context(console.client.page())
            assert page.welcome["type"] == "welcome"
        with console.client.socket("/ws") as late, pytest.raises(ConnectionClosed) as closed:
            late.recv(30)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1013


def test_connections_of_one_address_that_say_nothing_keep_no_other_out(console: ConsoleBesideNode) -> None:
    host, port = urlsplit(console.client.url).hostname, urlsplit(console.client.url).port
    with ExitStack() as stack:
        for _ in range(200):
            stack.enter_context(socket.create_connection((host, port), timeout=60))
        other = http.client.HTTPConnection(host or "", port, timeout=60, source_address=("127.0.0.2", 0))
        stack.callback(other.close)
        other.request("GET", "/")
        assert other.getresponse().status == 200


@pytest.mark.long
def test_a_connection_that_says_nothing_is_closed(console: ConsoleBesideNode) -> None:
    target = (urlsplit(console.client.url).hostname, urlsplit(console.client.url).port)
    with socket.create_connection(target, timeout=60) as silent:
        silent.sendall(b"GET / HTTP/1.1\r\n")
        with suppress(ConnectionResetError):
            assert silent.recv(1) == b""
