"""A ROS domain of one's own, so that nodes of strangers are neither met nor disturbed."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

_DOMAINS = range(1, 101)
"""Domain numbers whose UDP ports lie below those that Linux hands out by chance."""
_OTHER_REACHES = ("ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS")


@contextmanager
def own_domain() -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody else on this machine gets from here until the end of the block.

    Raises RuntimeError when all are taken.
    """
    for domain in _DOMAINS:
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                # An address in Linux's abstract namespace: held by one process, free again when that ends.
                claim.bind(f"\0yolov5_lifecycle/domain/{domain}")
            except OSError:
                continue
            yield domain
            return
    raise RuntimeError(f"all {len(_DOMAINS)} ROS domains for tests and demos are in use on this machine")


def isolated(environment: Mapping[str, str], domain: int) -> dict[str, str]:
    """`environment` for a process that keeps to `domain` of this machine."""
    # The older form would win over the range.
    kept = {name: value for name, value in environment.items() if name not in _OTHER_REACHES}
    return kept | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
