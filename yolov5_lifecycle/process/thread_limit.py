"""Check of the thread limit, which makes C++ libraries abort the process when exceeded."""

from __future__ import annotations

import os
import threading
from contextlib import suppress


def thread_problem(count: int) -> str:
    """Why `count` additional threads cannot run at the same time; "" if they can."""
    release, threads = threading.Event(), list[threading.Thread]()
    with suppress(RuntimeError):  # the thread limit is reached
        for _ in range(count):
            thread = threading.Thread(target=release.wait, daemon=True)
            thread.start()
            threads.append(thread)
    release.set()
    for thread in threads:
        thread.join()
    if len(threads) == count:
        return ""
    return (
        f"{count} threads are needed, {len(threads)} can be started: raise the limit of processes "
        "(`ulimit -u`, TasksMax= of systemd, --pids-limit of Docker), or end other processes of this user."
    )


def compute_threads() -> int:
    """Number of threads that the numerical libraries start for each of their pools."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
