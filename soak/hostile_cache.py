"""A cache full of pipes, devices and junk, and processes that end while writing to it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from support.special_cache_files import SPECIAL_CACHE_FILES

from soak.finding import Finding, none_wrong, number_of, problem
from soak.subject import Subject, subject_in
from yolov5_lifecycle.ros.child_process import own_domain
from yolov5_lifecycle.unfinished import FOLDER_PREFIX

_MAX_GROWN_MB = 300.0
_POLL_S = 0.0005
_CACHES = ("choices", "compiled")
_OWNER = """
import signal
from yolov5_lifecycle.unfinished import temporary_folder
with temporary_folder() as folder:
    (folder / "optimized.onnx").write_bytes(bytes(1000))
    print(folder, flush=True)
    signal.pause()
"""


def _each_file(make: Callable[[Path], object]) -> Callable[[Path], None]:
    """Replace every file of the cache with one created by `make`."""

    def replace(root: Path) -> None:
        paths = [path for folder in _CACHES for path in (root / folder).iterdir() if not path.is_dir()]
        for path in paths:
            path.unlink()
            path.with_name("fifo").unlink(missing_ok=True)  # target of a link
            make(path)

    return replace


def _each_folder(make: Callable[[Path], object]) -> Callable[[Path], None]:
    """Replace both cache folders with what `make` creates."""

    def replace(root: Path) -> None:
        for folder in _CACHES:
            shutil.rmtree(root / folder)
            make(root / folder)

    return replace


def _folder_instead(path: Path) -> None:
    (path / "inside").mkdir(parents=True)


CACHES: dict[str, Callable[[Path], None]] = {
    **{kind: _each_file(make) for kind, make in SPECIAL_CACHE_FILES.items()},
    "folder": _each_file(_folder_instead),
    **{f"{kind} in place of the folder": _each_folder(SPECIAL_CACHE_FILES[kind])
       for kind in ("FIFO", "link to an endless device", "link to itself")},
    "file in place of the folder": _each_folder(Path.touch),
}  # fmt: skip


def survived_caches(kinds: Iterable[str] = tuple(CACHES)) -> Finding:
    """Activate and detect with every kind of damage to a previously valid cache."""
    kinds, wrong, grown_mb = list(kinds), [], 0.0
    with (
        TemporaryDirectory() as cache,
        own_domain() as domain,
        subject_in(domain, XDG_CACHE_HOME=cache) as process,
    ):
        root = Path(cache) / "yolov5_lifecycle"
        _detect(process)
        before_mb = process.resources().resident_mb
        for kind in kinds:
            if told := problem(partial(_detect_beside, kind, root, process)):
                wrong.append(f"{kind}: {told}")
            grown_mb = max(grown_mb, process.resources().resident_mb - before_mb)
        escaped = process.escaped
    return Finding(
        claim="whatever lies in the cache, the node activates and detects",
        done=f"{len(kinds)} kinds of pipes, devices, links, folders and junk",
        result=f"{number_of('failures', wrong)}, {number_of('exceptions', escaped)}; {grown_mb:+.0f} MB",
        limit=f"0, 0; {_MAX_GROWN_MB:.0f} MB",
        is_met=not wrong and not escaped and grown_mb < _MAX_GROWN_MB,
    )


def removed_leftovers(signals: Sequence[signal.Signals]) -> Finding:
    """End a process with each of `signals` while it compiles; the next one removes their leftovers.

    A compilation may be over before the signal arrives, so one more process is killed while it surely holds a
    temporary folder.
    """
    with TemporaryDirectory() as folder, own_domain() as domain:
        variables = {"TMPDIR": folder, "XDG_CACHE_HOME": f"{folder}/cache"}
        _kill_owner(variables)
        left = [_end_while_it_compiles(domain, variables, number) for number in signals]
        with subject_in(domain, **variables) as process:
            _detect(process)
            remaining = [path.name for path in Path(folder).glob(f"{FOLDER_PREFIX}*")]
    return none_wrong(
        "what a process leaves that ends while it compiles is removed by the next",
        f"{len(signals)} processes ended by SIGKILL or SIGTERM; {sum(left) + 1} temporary folders left",
        "folders remain",
        remaining,
    )


def _detect_beside(kind: str, root: Path, process: Subject) -> None:
    process.bring_to("inactive")
    CACHES[kind](root)
    try:
        _detect(process)
    finally:
        shutil.rmtree(root)
        process.bring_to("inactive")
        _detect(process)  # fills the cache again


def _detect(process: Subject) -> None:
    process.bring_to("active")
    process.look()


def _kill_owner(variables: dict[str, str]) -> None:
    """Kill a process that holds a temporary folder, which stays behind."""
    with subprocess.Popen(
        [sys.executable, "-c", _OWNER], env=os.environ | variables, stdout=subprocess.PIPE, text=True
    ) as owner:
        assert owner.stdout is not None
        folder = Path(owner.stdout.readline().strip())
        owner.kill()
    assert folder.is_dir(), folder


def _end_while_it_compiles(domain: int, variables: dict[str, str], number: signal.Signals) -> bool:
    """End a process while it compiles; returns whether a new temporary folder is left."""
    folder = Path(variables["TMPDIR"])
    shutil.rmtree(variables["XDG_CACHE_HOME"], ignore_errors=True)
    with subject_in(domain, **variables) as process:
        assert process.node.set_parameters(runtime="onnxruntime") == ""
        process.bring_to("inactive")
        before = set(folder.glob(f"{FOLDER_PREFIX}*"))
        answer: Any = process.begin_transition("activate")
        while not (folders := set(folder.glob(f"{FOLDER_PREFIX}*")) - before) and not answer.done():
            process.observer.work_for(_POLL_S)
        process.process.stop(number)
    return any(path.exists() for path in folders)
