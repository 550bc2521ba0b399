"""A worker of `detect_bag` that answers with the lines in LIE_WHILE_LOADING and LIE_WHILE_RUNNING."""

from __future__ import annotations

import os
import socket

TRUTH = '{"ready": ["torch", "fp32"]}'


def main(descriptor: int) -> None:
    """Answer the plan, then each recording."""
    with socket.socket(fileno=descriptor) as connection, connection.makefile("r") as requests:
        next(requests)
        _send(connection, os.environ.get("LIE_WHILE_LOADING", TRUTH))
        for _ in requests:
            _send(connection, os.environ["LIE_WHILE_RUNNING"])


def _send(connection: socket.socket, text: str) -> None:
    if text.startswith("repeat "):
        letter, count = text.split()[1:]
        connection.sendall(letter.encode() * int(count))
    connection.sendall(text.encode() + b"\n")
