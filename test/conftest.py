"""Fixtures that every test may use."""

from __future__ import annotations

import ctypes
import gc
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

from yolov5_lifecycle.process.environment import prepare_environment

prepare_environment()  # as the commands do; child processes inherit it
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    # nohup ignores it, which child processes would inherit; a handler is reset to the default in them.
    signal.signal(signal.SIGHUP, lambda *_: None)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a script leaves it to what it starts with `&`
    signal.signal(signal.SIGINT, signal.default_int_handler)
# On every machine frames run one at a time, unless a test asks for more. Beside other workers, more threads
# for one network only wait for each other. Child processes inherit it.
os.environ["OMP_NUM_THREADS"] = "1"
# Memory of 1 MiB or more goes back to the system once a test frees it. Otherwise glibc raises the threshold
# (M_MMAP_THRESHOLD) with each larger array, up to 32 MiB, and keeps what is freed below it.
ctypes.CDLL(None).mallopt(-3, 1 << 20)

import pytest
from hypothesis import HealthCheck, settings
from support.colcon_workspace import REPOSITORY, build_workspace
from support.whole_run import WholeRun, Worker
from support.worker import made_once, run_folder, suitable_count, worker_domain

from yolov5_lifecycle.ros.child_process import isolated

# The variables of the `make` that starts the tests would reach each `make` that a test starts.
for name in [*re.findall(r"^(\w+) \?=", (REPOSITORY / "Makefile").read_text(), re.MULTILINE), "MFLAGS"]:
    os.environ.pop(name, None)
for name in [name for name in os.environ if name.startswith("MAKE")]:
    del os.environ[name]

pytest_plugins = ["support.page_fixtures", "support.refusals", "support.shared_fixtures"]

# A busy machine is no failure of an example, and the same commit gives the same result.
settings.register_profile(
    "suite", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("suite")


def pytest_configure(config: pytest.Config) -> None:
    is_worker = "PYTEST_XDIST_WORKER" in os.environ
    config.pluginmanager.register(Worker() if is_worker else WholeRun(config.getvalue("maxfail") or 0))
    if sys.version_info < (3, 11):  # asyncio's own: of a connection that the other side ended
        ended = "ignore:unclosed transport <asyncio.sslproto._SSLProtocolTransport:ResourceWarning"
        config.addinivalue_line("filterwarnings", ended)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    return suitable_count()


def pytest_collection_finish() -> None:
    """Spare the garbage collector what stays: many tests collect the nodes of earlier ones."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def reference_dir() -> Path:
    """Folder with weights/yolov5n.pt (official, AGPL-3.0), images/bus.jpg and golden/, its official answers.

    They are not part of this project.
    """
    folder = Path(os.environ.get("YOLOV5_REFERENCE_DIR") or REPOSITORY.parent / "shared")
    if not (folder / "golden" / "yolov5n_bus.json").is_file():
        pytest.skip(f"no reference data in {folder}: set YOLOV5_REFERENCE_DIR to the folder that has it")
    return folder


@pytest.fixture(scope="session", autouse=True)
def _isolated() -> Iterator[None]:
    """Nodes reach neither other machines nor the nodes of anybody else on this one."""
    with worker_domain() as domain, pytest.MonkeyPatch.context() as environment:
        for name, value in isolated({}, domain).items():
            environment.setenv(name, value)
        environment.setenv("no_proxy", "*")  # the servers of the tests are here
        yield


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests and their child processes leave the user's cache and logs alone."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        environment.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("log")))
        yield


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A colcon workspace in which the package has been built."""
    return made_once(run_folder(tmp_path_factory.getbasetemp()) / "workspace", build_workspace)


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody else on this machine uses during the test; child processes inherit it."""
    with worker_domain() as domain:
        for name, value in isolated({}, domain).items():
            monkeypatch.setenv(name, value)
        yield domain
