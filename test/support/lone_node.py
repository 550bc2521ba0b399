"""A node in a context of its own, which nobody spins yet."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.node import Node


@contextmanager
def lone_node(name: str, *words: str) -> Iterator[Node]:
    """The node `name` with these words on its command line; at the end it and its context are gone."""
    context = rclpy.Context()
    rclpy.init(context=context, args=[])
    node = rclpy.create_node(name, context=context, cli_args=[*words])
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)
