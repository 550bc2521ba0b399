"""The processes that run the tests at the same time: how many, what each has alone, what they make once."""

from __future__ import annotations

import fcntl
import gc
import itertools
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from yolov5_lifecycle.process.memory import available_bytes, cores
from yolov5_lifecycle.ros.child_process import DOMAINS, own_domain

_NUMBER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
_COUNT = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
_MAX_COUNT = 12
_TURNS = itertools.count()
_WORKER_BYTES = 2 << 30
"""What a worker and the processes that it starts need."""


def suitable_count() -> int:
    """How many workers this machine has room for: one more than cores, as tests of nodes also wait."""
    usable = min(len(os.sched_getaffinity(0)), int(cores() or _MAX_COUNT))
    return max(1, min(usable + 1, (available_bytes() or 0) // _WORKER_BYTES, _MAX_COUNT))


@contextmanager
def worker_domain() -> Iterator[int]:
    """Exclusive ROS domain that no other worker uses before or after, and this one only after all its others.

    A client may send its request to a node of a finished test that is still in the domain, and wait forever.
    Such nodes are removed by garbage collection, as they are in reference cycles, or found by nobody, as the
    next test has another domain. The last domains come first, as `demo` takes the first free one.
    """
    gc.collect()
    gc.freeze()  # what is left lives long: later collections need not look at it
    domains = DOMAINS[-1 - _NUMBER :: -_COUNT]
    turn = next(_TURNS) % len(domains)
    with own_domain([*domains[turn:], *domains[:turn]]) as domain:
        yield domain


def made_once(folder: Path, make: Callable[[Path], None]) -> Path:
    """`folder` after the first worker to ask for it has called `make(folder)`."""
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = folder.with_suffix(".done")
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


def run_folder(temporary: Path) -> Path:
    """The folder that all workers of this run share; `temporary` is the base folder of this one."""
    return temporary.parent if "PYTEST_XDIST_WORKER" in os.environ else temporary
