"""Age of images in a browser compared with the detector's latency, and the cost of viewers.

python -m benchmark.console [--rate 15] [--seconds 10] [--rounds 3] [--quick]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Origin

from benchmark.process_memory import cpu_s
from benchmark.report import Figures, Goal, Program, in_turns, quick, row
from yolov5_lifecycle.ros.child_process import ChildProcess
from yolov5_lifecycle.ros.demo.demonstrations import ONE_CAMERA
from yolov5_lifecycle.ros.demo.stage import started

VIEWERS = (1, 4)
MAX_AGE_MS = 100.0
"""Max age of an image in the browser beyond the latency of the detector."""
MAX_COST = 1.3
"""CPU time of the console with four viewers, with one viewer 1."""
NODE = "/yolov5"
_STAMP = struct.Struct("<d")
_ADDRESS = re.compile(r"console: http://(\S+)/")
_START_S = 60.0
_SETTLING_S = 3.0
_POLL_S = 0.02


@dataclass
class Viewing:
    """One measurement of `duration_s`: ages and node latencies in ms, CPU time of the console."""

    ages_ms: list[float] = field(default_factory=list)
    latencies_ms: list[float] = field(default_factory=list)
    cpu_s: float = 0.0
    duration_s: float = 0.0

    @property
    def cpu_percent(self) -> float:
        """Of one core."""
        return 100 * self.cpu_s / self.duration_s


@contextmanager
def robot(rate_hz: float) -> Iterator[ChildProcess]:
    """Camera, detector and console; the last of them, serving."""
    commands = {
        "camera": f"camera --ros-args -r image_raw:={NODE}/image_raw -p rate:={rate_hz}",
        "detector": f"{ONE_CAMERA['detector']} -p autostart:=true",
        "console": "console --port 0",
    }
    with started(commands) as (_, detector, console):
        detector.wait_for_output("active with weights", _START_S)
        console.wait_for_output("console: http", _START_S)
        yield console


def authority(console: ChildProcess) -> str:
    """Host and port of a console."""
    found = _ADDRESS.search(console.output)
    if found is None:
        raise RuntimeError(f"the console announced no address: {console.output}")
    return found[1]


async def viewing(console: ChildProcess, viewers: int, duration_s: float) -> Viewing:
    """Measure `viewers` browsers, each with the page and the images of the camera.

    It takes `duration_s`, or until an image was seen.
    """
    seen = Viewing()
    async with AsyncExitStack() as stack:
        tasks = []
        for _ in range(viewers):
            page = await stack.enter_async_context(_socket(console, "/ws"))
            await _wait_for_node(page)
            images = await stack.enter_async_context(_socket(console, f"/image?node={NODE}&camera="))
            tasks += [asyncio.create_task(_read(page, seen)), asyncio.create_task(_view(images, seen))]
        await _wait_for_an_image(seen)
        await asyncio.sleep(_SETTLING_S)
        seen.ages_ms.clear()
        seen.latencies_ms.clear()
        begun_s, begun_cpu_s = time.monotonic(), cpu_s(console.process_id)
        await asyncio.sleep(duration_s)
        await _wait_for_an_image(seen)
        seen.cpu_s = cpu_s(console.process_id) - begun_cpu_s
        seen.duration_s = time.monotonic() - begun_s
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return seen


def _socket(console: ChildProcess, path: str) -> connect:
    where = authority(console)
    return connect(f"ws://{where}{path}", origin=Origin(f"http://{where}"), compression=None, max_size=None)


async def _wait_for_node(page: ClientConnection) -> None:
    while json.loads(await page.recv())["type"] != "node":
        pass


async def _wait_for_an_image(seen: Viewing) -> None:
    """Wait for the first of the ages that are collected; raises RuntimeError on timeout."""
    deadline_s = time.monotonic() + _START_S
    while not seen.ages_ms:
        if time.monotonic() > deadline_s:
            raise RuntimeError(f"no viewer has seen an image in {_START_S:g} s")
        await asyncio.sleep(_POLL_S)


async def _read(page: ClientConnection, seen: Viewing) -> None:
    async for message in page:
        content = json.loads(message)
        if content["type"] == "node":
            latency_ms = content["node"]["cameras"][0]["latency_p95_ms"]
            seen.latencies_ms += [] if latency_ms is None else [latency_ms]


async def _view(images: ClientConnection, seen: Viewing) -> None:
    async for message in images:
        if isinstance(message, bytes):
            seen.ages_ms.append((time.time() - _STAMP.unpack_from(message)[0]) * 1e3)
            await images.send("taken")


def goals(seen: dict[int, list[Viewing]]) -> list[Goal]:
    """Age of images with one viewer beyond the detector's p95, and the cost of four viewers over one."""
    one, four = VIEWERS
    ages_ms = sorted(age_ms for each in seen[one] for age_ms in each.ages_ms)
    latencies_ms = [latency_ms for each in seen[one] for latency_ms in each.latencies_ms]
    p95_ms = ages_ms[round(0.95 * (len(ages_ms) - 1))]
    over_ms = p95_ms - sum(latencies_ms) / len(latencies_ms)
    cpu = {viewers: sum(each.cpu_s / each.duration_s for each in seen[viewers]) for viewers in VIEWERS}
    return [
        Goal("p95 of age over the detector's p95 latency, ms", 0, over_ms, True, MAX_AGE_MS),
        Goal("CPU with four viewers / with one", 0, cpu[four] / cpu[one], True, MAX_COST),
    ]


def measured(options: argparse.Namespace, _: Path) -> Figures:
    """One viewer and four in each round."""
    seconds, rounds = (3.0, 1) if options.quick else (options.seconds, options.rounds)
    with robot(options.rate) as console:
        calls = {
            viewers: lambda viewers=viewers: asyncio.run(viewing(console, viewers, seconds))
            for viewers in VIEWERS
        }
        seen = in_turns(calls, rounds)
    rows = []
    for viewers, each in seen.items():
        ages_ms = [age_ms for one in each for age_ms in one.ages_ms]
        rows.append(row("age", f"{viewers} viewers", 0, ages_ms))
        rows.append(row("CPU", f"{viewers} viewers", 0, [one.cpu_percent for one in each], unit="%"))
    return rows, goals(seen)


PROGRAM = Program(
    "console",
    __doc__,
    measured,
    {
        "--quick": quick("one short round"),
        "--rate": {"type": float, "default": 15.0, "help": "images per second"},
        "--seconds": {"type": float, "default": 10.0, "help": "of each round"},
        "--rounds": {"type": int, "default": 3, "help": "of one and of four viewers"},
    },
)


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
