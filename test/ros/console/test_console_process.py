"""How the console starts and ends: arguments, exit codes, signals, a detector that is killed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support.console_process import ConsoleClient, address, console_process
from support.detector_process import NODE, detector_process, environment
from support.worker import worker_domain

from yolov5_lifecycle.ros.child_process import entry_point
from yolov5_lifecycle.ros.console.options import parsed


def run(*words: str) -> subprocess.CompletedProcess[str]:
    with worker_domain() as domain:
        return subprocess.run(
            [entry_point("console"), *words],
            env=environment(domain),
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        pytest.param(["--port", "http"], "--port: expected a number from 0 to 65535", id="no number"),
        pytest.param(["--port", "65536"], "--port: expected a number from 0 to 65535", id="port"),
        pytest.param(["--key", "key.pem"], "--cert and --key: expected both", id="key alone"),
        pytest.param(["--node", "/yolov5/"], "expected the full name of a node", id="no node"),
        pytest.param(["--public-url", "robot"], "--public-url: expected a URL", id="no URL"),
        pytest.param(["--public-url", "http://a:b"], "--public-url: expected a URL", id="wrong port"),
        pytest.param(["--public-url", "https://a/b"], "scheme, name and port only", id="URL with path"),
    ],
)
def test_wrong_arguments_are_explained(
    capsys: pytest.CaptureFixture[str], words: list[str], expected: str
) -> None:
    with pytest.raises(SystemExit, match="2"):
        parsed(words)
    assert expected in capsys.readouterr().err


def test_a_port_in_use_is_explained() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        ended = run("--port", str(port))
    assert ended.returncode == 1
    assert f"port {port} of 127.0.0.1 is in use, perhaps by another console: choose" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.long
def test_an_argument_that_ros_refuses_is_explained() -> None:
    ended = run("--port", "0", "--ros-args", "-r", "__node:=a b")
    assert (ended.returncode, ended.stdout) == (2, "")
    assert "cannot start" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.end_to_end
def test_on_a_network_the_token_is_printed_once_and_opens_page_and_metrics(
    ros_domain: int, tmp_path: Path
) -> None:
    words = ["--host", "0.0.0.0", "--token-file", str(tmp_path / "token")]
    with console_process(ros_domain, *words) as process:
        token = (tmp_path / "token").read_text().strip()
        assert process.output.count(token) == 1
        client = ConsoleClient(f"http://127.0.0.1:{urlsplit(address(process)).port}/")
        assert client.request("GET", "/").status == 303
        assert client.request("GET", "/metrics", headers={"Authorization": f"Bearer {token}"}).status == 200
        with client.logged_in(token).page() as page:
            assert page.welcome["type"] == "welcome"
        assert "Traceback" not in process.output


@pytest.mark.end_to_end
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda one: one.name)
def test_a_signal_ends_it_with_code_0_while_pages_are_open(number: signal.Signals, ros_domain: int) -> None:
    with console_process(ros_domain) as process:
        place = ("127.0.0.1", urlsplit(address(process)).port or 0)
        with ConsoleClient(address(process)).page(), socket.create_connection(place, timeout=10):
            assert process.stop(number) == 0
        assert "Traceback" not in process.output


@pytest.mark.long
def test_a_detector_that_hangs_or_is_killed_is_gone_until_it_goes_on() -> None:
    with (
        detector_process() as detector,
        console_process(detector.domain) as process,
        ConsoleClient(address(process)).page() as page,
    ):
        page.wait_for(lambda: NODE in page.nodes, "the detector")
        os.kill(detector.process.process_id, signal.SIGSTOP)
        page.wait_for(lambda: page.gone == [NODE], "its silence")
        os.kill(detector.process.process_id, signal.SIGCONT)
        page.wait_for(lambda: NODE in page.nodes, "its return")
        detector.process.stop(signal.SIGKILL)
        page.wait_for(lambda: page.gone == [NODE, NODE], "its end")
        assert page.lost[NODE]["state"] == "unconfigured"
