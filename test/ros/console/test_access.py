"""Addresses, tokens, sessions and budgets of the console."""

from __future__ import annotations

import os
import socket
import stat
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Barrier

import pytest

from yolov5_lifecycle.ros.console.budget import Budget, Budgets
from yolov5_lifecycle.ros.console.gate import Addresses
from yolov5_lifecycle.ros.console.options import ConsoleOptions
from yolov5_lifecycle.ros.console.sessions import (
    MIN_TOKEN_LENGTH,
    SESSION_S,
    Sessions,
    TokenFileError,
    TooManyTriesError,
    kept_token,
    usual_path,
)

TOKEN = "t" * MIN_TOKEN_LENGTH
LOOPBACK = Addresses(scheme="http", is_loopback=True)
NETWORK = Addresses(scheme="http", is_loopback=False, public_urls=("https://robot.example",))
HERE = ("127.0.0.1", 8080)
THERE = ("192.0.2.7", 8080)
NAME = socket.gethostname().lower()


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.mark.parametrize(
    ("addresses", "server", "host", "scheme"),
    [
        pytest.param(LOOPBACK, HERE, "127.0.0.1:8080", "http", id="loopback"),
        pytest.param(LOOPBACK, HERE, "LocalHost:8080", "http", id="localhost"),
        pytest.param(LOOPBACK, ("::1", 8080), "[::1]:8080", "http", id="IPv6"),
        pytest.param(LOOPBACK, ("127.0.0.1", 80), "localhost", "http", id="port 80"),
        pytest.param(LOOPBACK, HERE, "127.0.0.1", "", id="another port"),
        pytest.param(LOOPBACK, HERE, f"{NAME}.example:8080", "", id="rebound name"),
        pytest.param(LOOPBACK, HERE, "127.0.0.1.example.com:8080", "", id="name that begins like an address"),
        pytest.param(LOOPBACK, HERE, "127.0.0.1:8080@example.com", "", id="user"),
        pytest.param(LOOPBACK, HERE, "", "", id="empty"),
        pytest.param(LOOPBACK, HERE, "[::1:8080", "", id="open bracket"),
        pytest.param(LOOPBACK, HERE, "localhost:99999999999", "", id="long port"),
        pytest.param(NETWORK, THERE, "192.0.2.7:8080", "http", id="own address"),
        pytest.param(NETWORK, ("::ffff:192.0.2.7", 8080), "192.0.2.7:8080", "http", id="mapped address"),
        pytest.param(NETWORK, THERE, "192.0.2.8:8080", "", id="another address"),
        pytest.param(NETWORK, THERE, f"{NAME}.local:8080", "http", id="own name"),
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
        pytest.param("http://example.com", False, id="foreign"),
        pytest.param("null", False, id="null"),
        pytest.param("", False, id="empty"),
        pytest.param("http://127.0.0.1:8080.example.com", False, id="longer"),
    ],
)
def test_an_origin_is_own_or_foreign(origin: str, *, is_own: bool) -> None:
    assert LOOPBACK.is_own_origin(origin, "127.0.0.1:8080", "http") is is_own


def test_an_origin_leaves_out_the_usual_port() -> None:
    assert NETWORK.is_own_origin("https://robot.example", "robot.example:443", "https")


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("127.0.0.1", True),
        ("127.1.2.3", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("192.0.2.7", False),
        ("robot", False),
    ],
)
def test_loopback_addresses_are_known(host: str, *, expected: bool) -> None:
    assert ConsoleOptions(host=host).is_loopback is expected


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


def test_consoles_that_start_together_share_one_token(tmp_path: Path) -> None:
    together = Barrier(8)

    def start(path: Path) -> tuple[str, bool]:
        together.wait()
        return kept_token(path)

    paths = [tmp_path / f"token {turn}" for turn in range(100)]
    with ThreadPoolExecutor(8) as consoles:
        for path in paths:
            found = list(consoles.map(start, [path] * 8))
            assert len({token for token, _ in found}) == 1
            assert [is_new for _, is_new in found].count(True) == 1
    assert sorted(tmp_path.iterdir()) == sorted(paths)


def test_two_tokens_differ(tmp_path: Path) -> None:
    assert kept_token(tmp_path / "one") != kept_token(tmp_path / "two")


@pytest.mark.parametrize(
    ("content", "mode", "words"),
    [
        pytest.param(TOKEN, 0o644, "others may have read", id="readable by others"),
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
    with pytest.raises(TokenFileError, match=words):
        kept_token(path)


def test_a_link_and_a_folder_are_no_token_files(tmp_path: Path) -> None:
    (tmp_path / "other").write_text(TOKEN)
    (tmp_path / "link").symlink_to(tmp_path / "other")
    for path in (tmp_path / "link", tmp_path):
        with pytest.raises(TokenFileError, match="--token-file"):
            kept_token(path)


def test_the_usual_file_is_in_the_state_folder() -> None:
    assert usual_path({"XDG_STATE_HOME": "/state"}) == Path("/state/yolov5_console/token")
    assert usual_path({"XDG_STATE_HOME": "relative"}) == Path.home() / ".ros/yolov5_console/token"
    assert usual_path({}) == Path.home() / ".ros/yolov5_console/token"


def test_a_user_without_a_home_is_told_to_set_it_or_choose_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "~")  # as Python leaves it for a user whom the machine does not know
    with pytest.raises(TokenFileError, match=r"no home folder\. Set HOME, or .* --token-file"):
        usual_path({})


def test_a_session_has_a_random_id_and_ends() -> None:
    clock = Clock()
    sessions = Sessions(TOKEN, clock=clock)
    first, second = sessions.begin(), sessions.begin()
    assert first != second
    assert TOKEN not in first
    assert sessions.left_s(first) == SESSION_S
    assert sessions.left_s("") == 0
    assert sessions.left_s(TOKEN) == 0
    clock.now_s = SESSION_S - 1
    assert sessions.left_s(first) == 1
    clock.now_s = SESSION_S + 1
    assert sessions.left_s(first) == 0


def test_wrong_tokens_are_throttled_for_each_address() -> None:
    clock = Clock()
    sessions = Sessions(TOKEN, clock=clock)
    assert [sessions.knows_token(f"wrong {number}", "192.0.2.1") for number in range(5)] == [False] * 5
    with pytest.raises(TooManyTriesError):
        sessions.knows_token("wrong", "192.0.2.1")
    assert not sessions.knows_token("wrong", "192.0.2.2")
    clock.now_s = 12.0
    assert not sessions.knows_token("wrong", "192.0.2.1")


def test_the_right_token_counts_however_many_were_wrong() -> None:
    sessions = Sessions(TOKEN, clock=Clock())
    for number in range(100):
        with suppress(TooManyTriesError):
            sessions.knows_token(f"wrong {number}", "192.0.2.1")
    assert sessions.knows_token(TOKEN, "192.0.2.1")


def test_a_budget_refills() -> None:
    clock = Clock()
    budget = Budget(2.0, 3, clock=clock)
    assert [budget.spend() for _ in range(4)] == [True, True, True, False]
    clock.now_s = 0.5
    assert [budget.spend() for _ in range(2)] == [True, False]
    clock.now_s = 100.0
    assert [budget.spend() for _ in range(4)] == [True, True, True, False]


def test_budgets_of_addresses_are_forgotten_the_oldest_first() -> None:
    made: list[Budget] = []

    def make() -> Budget:
        made.append(Budget(1.0, 1))
        return made[-1]

    budgets = Budgets(make)
    first = budgets.of("first")
    assert budgets.of("first") is first
    for number in range(1000):
        budgets.of(str(number))
    assert budgets.of("999") is made[-1]
    assert budgets.of("first") is not first
