"""Exclusive ROS domain, isolated from other nodes."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

DOMAINS: Sequence[int] = range(1, 101)
"""Domain ids whose UDP ports lie below Linux's ephemeral port range."""
_OTHER_REACHES = ("ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS")


@contextmanager
def own_domain(domains: Sequence[int] = DOMAINS) -> Iterator[int]:
    """The first of `domains` (values of ROS_DOMAIN_ID) that no other caller on this machine holds.

    It is held until the end of the block. Raises RuntimeError if all are in use.
    """
    for domain in domains:
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                # An abstract Linux socket address: held by one process, released when the process ends.
                claim.bind(f"\0yolov5_lifecycle/domain/{domain}")
            except OSError:
                continue
            yield domain
            return
    raise RuntimeError(f"all {len(domains)} ROS domains for tests and demos are in use on this machine")


def isolated(environment: Mapping[str, str], domain: int) -> dict[str, str]:
    """`environment` for a process restricted to `domain` on this machine."""
    # ROS_LOCALHOST_ONLY, the older variable, would override the discovery range.
    kept = {name: value for name, value in environment.items() if name not in _OTHER_REACHES}
    return kept | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
