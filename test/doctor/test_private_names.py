"""A report has no names of people and machines, and keeps what matters."""

from __future__ import annotations

import pytest

from yolov5_lifecycle.doctor.command import public
from yolov5_lifecycle.doctor.finding import warning
from yolov5_lifecycle.doctor.private_names import without_private_names


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ""),
        ("/home/ada/.cache is full", "~/.cache is full"),
        ("/home/ada", "~"),
        ("/home/adam/x", "/home/(user)/x"),
        ("/home/bob/x and /Users/eve/y", "/home/(user)/x and /Users/(user)/y"),
        ("/data/ada/models", "/data/(user)/models"),
        ("ada@walle.lab.example: no route to walle", "(user)@(host): no route to (host)"),
        ("adaptive walleye", "adaptive walleye"),
        ("aa:bb:cc:dd:ee:ff at 192.168.1.20", "(address) at (address)"),
        ("10.0.0.7 and 172.20.1.2 and 127.0.0.1", "(address) and (address) and (address)"),
        ("OpenCV 4.10.0.84, driver 550.54.15", "OpenCV 4.10.0.84, driver 550.54.15"),
        ("GPU-1f2e3d4c-0a1b-2c3d-4e5f-60718293a4b5 lost", "(serial) lost"),
        ("/dev/v4l/by-id/usb-046d_C920_5A2B-index0 is busy", "/dev/(serial) is busy"),
    ],
)
def test_private_names_are_replaced(text: str, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "walle.lab.example")
    monkeypatch.setenv("HOME", "/home/ada")
    monkeypatch.setenv("USER", "ada")
    assert without_private_names(text) == expected


def test_names_that_everybody_has_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "ubuntu")
    monkeypatch.setenv("HOME", "/")
    monkeypatch.setenv("USER", "ros")
    text = "root in /opt/ros on ubuntu"
    assert without_private_names(text) == text


def test_a_line_of_the_report_has_none_and_is_printable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/ada")
    monkeypatch.setenv("USER", "ada")
    assert public(warning("/home/ada/\x1b[31m", remedy="ask ada\nor wait")) == warning(
        "~/?[31m", remedy="ask (user) or wait"
    )
