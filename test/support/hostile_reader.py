"""Reads hostile weights files in a process of its own, and writes what came of it as one JSON line a file.

`python hostile_reader.py VALID FILE ...`: first a valid file, for what torch does only once and takes memory
for.
"""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from pathlib import Path

from benchmark.process_memory import forget_peak, limit_growth, peak_resident_mb, resident_mb
from yolov5_lifecycle.checkpoints.locate import load_weights

MEMORY_MB = 2048
"""What the process may map besides what it has mapped after the imports and the first file."""
SUSPECT = (
    *("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen"),
    *("socket.", "shutil.", "os.remove"),
)


def read(path: str) -> dict[str, object]:
    forget_peak()
    before_mb, begin_s = resident_mb(os.getpid()), time.process_time()
    try:
        load_weights(Path(path))
        outcome, message = "accepted", ""
    except BaseException as error:  # noqa: BLE001 - what it is, the test decides
        outcome, message = type(error).__name__, str(error)
    return {
        "path": path,
        "outcome": outcome,
        "message": message,
        "cpu_s": time.process_time() - begin_s,
        "grown_mb": peak_resident_mb(os.getpid()) - before_mb,
    }


def main(valid: str, *files: str) -> None:
    events: list[str] = []
    warnings.simplefilter("error")
    load_weights(Path(valid))
    limit_growth(MEMORY_MB)
    sys.addaudithook(lambda event, _: events.append(event) if event.startswith(SUSPECT) else None)
    for path in files:
        answer = read(path)
        sys.stdout.write(json.dumps(answer | {"events": list(events)}) + "\n")
        events.clear()


if __name__ == "__main__":
    main(*sys.argv[1:])
