"""Addresses, cookies, tokens and sessions of the console."""

from __future__ import annotations

import os
import socket
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest
from starlette.exceptions import HTTPException

from yolov5_lifecycle.ros.console.gate import Addresses, values_of
from yolov5_lifecycle.ros.console.options import parsed
from yolov5_lifecycle.ros.console.sessions import (
    MIN_TOKEN_LENGTH,
    SESSION_S,
    Sessions,
    kept_token,
    usual_path,
)

TOKEN = "t" * MIN_TOKEN_LENGTH
LOOPBACK = Addresses(parsed([]))
NETWORK = Addresses(parsed(["--host", "0.0.0.0", "--public-url", "https://robot.example"]))
HERE = ("127.0.0.1", 8080)
THERE = ("192.0.2.7", 8080)
NAME = socket.gethostname().lower()


@pytest.mark.parametrize(
    ("addresses", "server", "host", "scheme"),
    [
        pytest.param(LOOPBACK, HERE, "127.0.0.1:8080", "http", id="loopback"),
        pytest.param(LOOPBACK, HERE, "LocalHost:8080", "http", id="localhost"),
        pytest.param(LOOPBACK, ("::1", 8080), "[::1]:8080", "http", id="IPv6"),
        pytest.param(LOOPBACK, ("127.0.0.1", 80), "localhost", "http", id="port 80"),
        pytest.param(LOOPBACK, HERE, "127.0.0.1", "", id="another port"),
        pytest.param(LOOPBACK, HERE, "127.0.0.1.example.com:8080", "", id="name that begins like an address"),
        pytest.param(LOOPBACK, HERE, "[::1:8080", "", id="open bracket"),
        pytest.param(LOOPBACK, HERE, "localhost:99999999999", "", id="long port"),
        pytest.param(LOOPBACK, HERE, "localhost:8080/x", "", id="path"),
        pytest.param(LOOPBACK, HERE, "user@localhost:8080", "", id="user of this machine"),
        pytest.param(NETWORK, THERE, "192.0.2.7:8080", "http", id="own address"),
        pytest.param(NETWORK, ("::ffff:192.0.2.7", 8080), "192.0.2.7:8080", "http", id="mapped address"),
        pytest.param(NETWORK, THERE, "192.0.2.8:8080", "", id="another address"),
        pytest.param(NETWORK, THERE, f"{NAME}.local:8080", "http", id="own name"),
        pytest.param(NETWORK, THERE, f"{NAME}.example:8080", "", id="rebound name"),
        pytest.param(NETWORK, HERE, "robot.example", "https", id="public URL"),
        pytest.param(NETWORK, HERE, "robot.example:443", "https", id="public URL with port"),
        pytest.param(NETWORK, HERE, "robot.example:80", "", id="public URL at another port"),
    ],
)
def test_a_host_is_own_or_foreign(
    addresses: Addresses, server: tuple[str, int], host: str, scheme: str
) -> None:
    assert addresses.scheme_of(host, server) == scheme


@pytest.mark.parametrize(
    ("origin", "is_own"),
    [
        pytest.param("http://127.0.0.1:8080", True, id="own"),
        pytest.param("https://127.0.0.1:8080", False, id="scheme"),
        pytest.param("http://127.0.0.1:8081", False, id="port"),
        pytest.param("http://localhost:8080", False, id="another name of the same"),
        pytest.param("null", False, id="null"),
        pytest.param("http://127.0.0.1:8080.example.com", False, id="longer"),
    ],
)
def test_an_origin_is_own_or_foreign(origin: str, *, is_own: bool) -> None:
    assert LOOPBACK.is_own_origin(origin, "127.0.0.1:8080", "http") is is_own


def test_an_origin_leaves_out_the_usual_port() -> None:
    assert NETWORK.is_own_origin("https://robot.example", "robot.example:443", "https")


def test_a_token_is_needed_but_on_a_loopback_address_without_a_public_url() -> None:
    own, others = ["127.0.0.1", "127.1.2.3", "::1", "localhost"], ["0.0.0.0", "::", "192.0.2.7", "robot"]
    assert [host for host in [*own, *others] if not parsed(["--host", host]).needs_token] == own
    public = ["--public-url", "https://robot.example"]
    assert [host for host in own if not parsed(["--host", host, *public]).needs_token] == []


@pytest.mark.parametrize(
    "odd",
    [
        pytest.param('prefs={"a":1}', id="JSON"),
        pytest.param("consent", id="no equals sign"),
        pytest.param("=nothing;;k=", id="empty"),
        pytest.param('k="open', id="quotation mark"),
        pytest.param("user@host=1", id="at sign in name"),
        pytest.param("Path=/; Expires=Thu, 01 Jan 1970 00:00:00 GMT", id="attributes"),
        pytest.param("k=\u00fcber\ta==", id="beyond ASCII"),
        pytest.param("console_80801=x; k=console_8080; Console_8080=y; console_8080", id="similar names"),
    ],
)
def test_a_cookie_is_found_among_odd_ones_of_other_programs(odd: str) -> None:
    own, other = "console_8080=abc-_123", "console_8080=b"
    for header in (f"{odd}; {own}", f"{own}; {odd}", f"{odd};{own};{odd}"):
        assert values_of("console_8080", [header]) == ["abc-_123"]
    assert values_of("console_8080", [f"{own}; {other}", other]) == ["abc-_123", "b", "b"]
    assert values_of("console_8080", ["", odd]) == []


def test_a_token_is_made_once_and_kept_for_its_user_alone(tmp_path: Path) -> None:
    path = tmp_path / "state" / "token"
    before = os.umask(0)
    try:
        token, is_new = kept_token(path)
    finally:
        os.umask(before)
    assert is_new
    assert len(token) >= MIN_TOKEN_LENGTH
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert kept_token(path) == (token, False)
    assert kept_token(tmp_path / "other")[0] != token


def test_consoles_that_start_together_share_one_token(tmp_path: Path) -> None:
    together = Barrier(8)

    def start(path: Path) -> tuple[str, bool]:
        together.wait()
        return kept_token(path)

    paths = [tmp_path / f"token {turn}" for turn in range(30)]
    with ThreadPoolExecutor(8) as consoles:
        for path in paths:
            found = list(consoles.map(start, [path] * 8))
            assert len({token for token, _ in found}) == 1
            assert [is_new for _, is_new in found].count(True) == 1
    assert sorted(tmp_path.iterdir()) == sorted(paths)


@pytest.mark.parametrize(
    ("content", "mode", "words"),
    [
        pytest.param(TOKEN, 0o604, "others may have read", id="readable by others"),
        pytest.param(TOKEN, 0o620, "others may have read", id="writable by the group"),
        pytest.param("short", 0o600, "at least 32", id="short"),
        pytest.param("", 0o600, "at least 32", id="empty"),
        pytest.param("two words " * 10, 0o600, "expected one token", id="several words"),
    ],
)
def test_a_token_file_that_is_not_safe_is_refused(
    tmp_path: Path, content: str, mode: int, words: str
) -> None:
    path = tmp_path / "token"
    path.write_text(content)
    path.chmod(mode)
    with pytest.raises(OSError, match=words):
        kept_token(path)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        pytest.param("/dev/null", "is not a regular file: remove it, or choose another", id="device"),
        pytest.param("/proc", "is not a regular file: remove it, or choose another", id="folder"),
        pytest.param("/proc/x/token", "cannot be stored in /proc/x/token", id="no folder"),
    ],
)
def test_what_cannot_store_a_token_is_refused(path: str, words: str) -> None:
    with pytest.raises(OSError, match=f"{words}.* with --token-file"):
        kept_token(Path(path))


def test_the_usual_file_is_in_the_state_folder() -> None:
    assert usual_path({"XDG_STATE_HOME": "/state"}) == Path("/state/yolov5_console/token")
    assert usual_path({"XDG_STATE_HOME": "relative"}) == Path.home() / ".ros/yolov5_console/token"
    assert usual_path({}) == Path.home() / ".ros/yolov5_console/token"


def test_a_user_without_a_home_is_told_to_set_it_or_choose_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "~")  # as Python leaves it for a user whom the machine does not know
    with pytest.raises(OSError, match=r"no home folder\. Set HOME, or .* --token-file"):
        usual_path({})


def test_a_session_has_a_random_id_and_ends() -> None:
    now_s = 0.0
    sessions = Sessions(TOKEN, clock=lambda: now_s)
    first, second = sessions.begin(), sessions.begin()
    assert first != second
    assert TOKEN not in first
    assert sessions.left_s(first) == SESSION_S
    assert sessions.left_s("") == 0
    assert sessions.left_s(TOKEN) == 0
    now_s = SESSION_S - 1
    assert sessions.left_s(first) == 1
    now_s = SESSION_S + 1
    assert sessions.left_s(first) == 0


def test_wrong_tokens_are_throttled_for_each_address() -> None:
    now_s = 0.0
    sessions = Sessions(TOKEN, clock=lambda: now_s)
    assert [sessions.knows_token(f"wrong {number}", "192.0.2.1") for number in range(5)] == [False] * 5
    with pytest.raises(HTTPException, match="429: too many wrong tokens"):
        sessions.knows_token("wrong", "192.0.2.1")
    assert not sessions.knows_token("wrong", "192.0.2.2")
    assert sessions.knows_token(TOKEN, "192.0.2.1")  # the right one counts always
    for later_s, tries in ((12.0, 1), (10_000.0, 5)):
        now_s = later_s
        assert not any(sessions.knows_token("wrong", "192.0.2.1") for _ in range(tries))
        with pytest.raises(HTTPException):
            sessions.knows_token("wrong", "192.0.2.1")
