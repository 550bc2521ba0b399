"""How the console starts and ends: arguments, exit codes, signals, a detector that is killed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.console_process import ConsoleClient, Page, address, console_process
from support.detector_process import NODE, DetectorProcess, detector_process, environment
from support.worker import worker_domain

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point


def run(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    with worker_domain() as domain:
        return subprocess.run(
            [entry_point("console"), *words],
            env=environment(domain) | variables,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        pytest.param(["extra"], "unrecognized arguments: extra", id="unknown"),
        pytest.param(
            ["--port", "http"],
            "--port: expected a number from 0 to 65535",
            id="port is no number",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--port", "65536"],
            "--port: expected a number from 0 to 65535",
            id="port",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--node", "yolov5"],
            "--node: expected a full name such as /yolov5",
            id="node",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--key", "key.pem"], "--cert and --key: expected both", id="key alone", marks=pytest.mark.long
        ),
        pytest.param(["--public-url", "robot"], "--public-url: expected a URL", id="no URL"),
        pytest.param(
            ["--public-url", "http://a:b"],
            "--public-url: expected a URL",
            id="wrong port",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["--public-url", "https://a/b"],
            "scheme, name and port only",
            id="URL with path",
            marks=pytest.mark.long,
        ),
        pytest.param(["--ros-args", "-r", "__node:=a b"], "cannot start", id="ROS argument"),
    ],
)
def test_wrong_arguments_are_explained(words: list[str], expected: str) -> None:
    ended = run(*words)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert expected in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_port_in_use_is_explained() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        ended = run("--port", str(port))
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1] == (
        f"console: port {port} of 127.0.0.1 is in use, perhaps by another console: "
        "choose another with --port, or stop that one"
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        pytest.param(["--host", "192.0.2.1"], "not an address of this machine", id="address"),
        pytest.param(["--host", "no.such.name.invalid"], "expected an address or name", id="name"),
        pytest.param(["--cert", "/none.pem", "--key", "/none.pem"], "expected a certificate", id="no files"),
        pytest.param(["--public-url", "http://a", "--token-file", "/dev/null"], "regular file", id="token"),
        pytest.param(
            ["--public-url", "http://a", "--token-file", "/proc/x/token"], "--token-file", id="no folder"
        ),
    ],
)
def test_an_address_or_file_that_cannot_be_used_is_explained(
    words: list[str], expected: str, tmp_path: Path
) -> None:
    ended = run("--port", "0", *words, XDG_STATE_HOME=str(tmp_path))
    assert ended.returncode == 1
    assert expected.lower() in ended.stderr.lower()
    assert "Traceback" not in ended.stderr


@pytest.mark.long
@pytest.mark.parametrize("module", ["starlette", "uvicorn", "websockets", "prometheus_client"])
def test_a_missing_package_is_named_with_its_remedy(module: str) -> None:
    program = (
        f"import sys; sys.modules[{module!r}] = None; sys.argv = ['console'];"
        "from yolov5_lifecycle.ros.entry_points import console; console()"
    )
    with worker_domain() as domain:
        ended = subprocess.run(
            [sys.executable, "-c", program],
            env=environment(domain),
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
    assert ended.returncode == 1
    assert f"pip install {module.replace('_', '-')}" in ended.stderr


@pytest.mark.end_to_end
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda one: one.name)
def test_a_signal_ends_it_with_code_0_while_pages_are_open(number: signal.Signals, ros_domain: int) -> None:
    with console_process(ros_domain) as process:
        client = ConsoleClient(address(process))
        with client.page(), socket.create_connection(("127.0.0.1", _port(client)), timeout=10):
            assert process.stop(number) == 0
        assert "Traceback" not in process.output


def test_version_and_help_need_no_ros() -> None:
    assert run("--version").stdout.startswith("console ")
    assert "--view-only" in run("--help").stdout


@contextmanager
def shown_detector() -> Iterator[tuple[DetectorProcess, Page]]:
    """A detector, and the page of a console that shows it."""
    with (
        detector_process() as detector,
        console_process(detector.domain) as process,
        ConsoleClient(address(process)).page() as page,
    ):
        page.wait_for(lambda: NODE in page.nodes, "the detector")
        yield detector, page


@pytest.mark.long
def test_a_detector_that_is_killed_is_gone_until_it_is_started_again() -> None:
    with shown_detector() as (killed, page):
        killed.process.stop(signal.SIGKILL)
        page.wait_for(lambda: page.gone == [NODE], "its end")
        lost = page.lost[NODE]
        assert (lost["state"], lost["transitions"], lost["busy"]) == ("lost", [], "")
        assert {status["level"] for status in lost["diagnostics"]} == {3}
        assert [(camera["rate_hz"], camera["level"]) for camera in lost["cameras"]] == [(None, 3)]
        words = [entry_point("detector"), "--ros-args", "-p", "max_rate:=3.0"]
        with ChildProcess("detector", words, environment(killed.domain)):
            page.wait_for(lambda: NODE in page.nodes, "the new one")
            assert page.parameter("max_rate")["value"] == 3.0
            assert page.transition("configure") == ""
            page.wait_for_state("inactive")


@pytest.mark.long
def test_a_detector_that_hangs_is_gone_until_it_goes_on() -> None:
    with shown_detector() as (hung, page):
        os.kill(hung.process.process_id, signal.SIGSTOP)
        page.wait_for(lambda: page.gone == [NODE], "its silence")
        os.kill(hung.process.process_id, signal.SIGCONT)
        page.wait_for(lambda: NODE in page.nodes, "its return")
        assert page.transition("configure") == ""
        page.wait_for_state("inactive")


def _port(client: ConsoleClient) -> int:
    return int(client.origin.rpartition(":")[2])
