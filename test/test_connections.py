"""The commands open no connections but those of ROS, and write only the files that docs/security.md names.

As a program, which the test runs alone in its namespaces and with the rights of root there, as
`unshare --map-root-user --net --mount` gives them to anybody: runs each command for a while in a network
of which every packet that leaves it is recorded. The arguments are an empty folder and an image. Prints as
JSON, by command, what it connected to and the files that were written.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY, SUPPORT_PATH
from support.detector_process import NODE, PARAMETERS, as_arguments, environment
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.observer import Observer

DOMAIN = 1  # nobody else is in this network
PATIENCE_S = 120.0
ALL_PROTOCOLS = 3
UDP, TCP, IGMP, ICMP6 = 17, 6, 2, 58
FOLDERS = {"HOME": "home", "XDG_CACHE_HOME": "cache", "TMPDIR": "temporary", "ROS_LOG_DIR": "log"}
MODEL = REPOSITORY / "weights" / "shapes.safetensors"
CONTROL = """
import os, pathlib, socket
for variable in ("HOME", "XDG_CACHE_HOME", "TMPDIR", "ROS_LOG_DIR"):
    pathlib.Path(os.environ[variable], "control").touch()
socket.create_connection(("192.0.2.1", 80), 0.5)
"""
"""Writes into each of `FOLDERS` and connects, so that a recorder that misses either is noticed."""
ALONE = ["unshare", "--map-root-user", "--net", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
LOG = r"log/[^/]+\.log"
EXPECTED = {
    "nodes": (0, [], [LOG, LOG]),
    "detect_bag": (0, [], []),
    "openvino": (0, [], []),
    "evaluate": (0, [], []),
    "convert": (0, [], []),
    "fetch_weights": (0, ["look-up of weights.test"], []),
    "control": (1, ["TCP to 192.0.2.1:80"], [f"{folder}/control" for folder in sorted(FOLDERS.values())]),
}
"""By command, the connections, where packets went, and the files; the control shows that all are recorded."""


def connections() -> int:
    """How many connections the processes in this network have begun over TCP, also within the machine."""
    _, of_tcp = re.findall(r"^Tcp: (.*)$", Path("/proc/net/snmp").read_text(), re.MULTILINE)
    return int(of_tcp.split()[4])  # ActiveOpens


def destinations(recorder: socket.socket) -> list[str]:
    """Where what has left the machine since the last call was sent, except by the kernel itself."""
    found = {""}
    with contextlib.suppress(BlockingIOError):
        while True:
            data, address = recorder.recvfrom(65535)
            found.add(_destination(data, address[1]))
    return sorted(found - {""})


def _destination(data: bytes, ethernet_type: int) -> str:
    if ethernet_type == 0x0800:
        protocol, start, host = data[9], 4 * (data[0] & 15), socket.inet_ntop(socket.AF_INET, data[16:20])
    elif ethernet_type == 0x86DD:
        protocol, start, host = data[6], 40, socket.inet_ntop(socket.AF_INET6, data[24:40])
    else:
        return ""
    if protocol not in (UDP, TCP):
        return "" if protocol in (IGMP, ICMP6, 0, 1) else f"protocol {protocol} to {host}"
    (port,) = struct.unpack_from("!H", data, start + 2)
    if protocol == UDP and port == 53:
        question, _, _ = data[start + 8 + 12 :].partition(b"\0")  # a label has its length before it
        return "look-up of " + re.sub(r"[\0-\x1f]", ".", question.decode(errors="replace"))[1:]
    return f"{'UDP' if protocol == UDP else 'TCP'} to {host}:{port}"


def prepare_network(folder: Path) -> socket.socket:
    """A loopback, a way to everywhere that ends nowhere, and who records what goes that way."""
    resolver = folder / "resolv.conf"
    resolver.write_text("nameserver 192.0.2.53\noptions timeout:1 attempts:1\n")
    for command in (
        "ip link set lo up",
        "ip link add nowhere type veth peer name end",
        "ip link set nowhere arp off",
        "ip link set end up",
        "ip link set nowhere up",
        "ip address add 198.51.100.1/24 dev nowhere",
        "ip route add default dev nowhere",
        f"mount --bind {resolver} /etc/resolv.conf",
        "mount -t tmpfs none /dev/shm",
    ):
        subprocess.run(command.split(), check=True)
    recorder = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM)
    recorder.bind(("nowhere", ALL_PROTOCOLS))
    recorder.setblocking(False)
    return recorder


def run_nodes(variables: Mapping[str, str]) -> None:
    """Camera and detector until images have been detected with ONNX Runtime."""
    camera = [entry_point("camera"), "--ros-args", "-r", f"image_raw:={NODE}/image_raw"]
    parameters = PARAMETERS | {"runtime": "onnxruntime", "autostart": True}
    detector = [entry_point("detector"), "--ros-args", *as_arguments(parameters)]
    detections: list[Detection2DArray] = []
    with (
        ChildProcess("camera", camera, variables) as camera_process,
        ChildProcess("detector", detector, variables) as process,
        closing(Observer("client", domain=DOMAIN, check=process.check_running)) as observer,
    ):
        observer.create_subscription(Detection2DArray, f"{NODE}/detections", detections.append, 10)
        observer.wait_for(lambda: len(detections) > 5, "detections", timeout_s=PATIENCE_S)
        codes = [each.stop(signal.SIGTERM, timeout_s=PATIENCE_S) for each in (camera_process, process)]
        assert codes == [0, 0], camera_process.output + process.output


def run_command(*words: str, code: int = 0) -> Callable[[Mapping[str, str]], None]:
    """Run a command to its end, which must have this `code`."""

    def run(variables: Mapping[str, str]) -> None:
        ended = subprocess.run(words, env=dict(variables), capture_output=True, text=True, timeout=PATIENCE_S)
        assert ended.returncode == code, ended.stderr

    return run


def labelled(folder: Path, image: Path) -> Path:
    """A new data set of the one `image`."""
    folder.mkdir()
    (folder / "image.png").write_bytes(image.read_bytes())
    (folder / "image.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    (folder / "data.yaml").write_text("val: .\nnames: [circle]\n")
    return folder


def written(folder: Path) -> list[str]:
    """The files below `folder`."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir())


def main() -> None:
    folder = Path(sys.argv[1])
    image, converted = folder / "image.png", folder / "out" / "converted.safetensors"
    image.write_bytes(Path(sys.argv[2]).read_bytes())
    recorder = prepare_network(folder)
    model = f"weights={MODEL}"
    trials: dict[str, Callable[[Mapping[str, str]], None]] = {
        "nodes": run_nodes,
        "detect_bag": run_command(
            entry_point("detect_bag"), str(image), "--set", model, "--set", "runtime=onnxruntime"
        ),
        "openvino": run_command(
            entry_point("detect_bag"), str(image), "--set", model, "--set", "runtime=openvino"
        ),
        "evaluate": run_command(
            *(entry_point("evaluate"), str(MODEL), str(labelled(folder / "data", image))),
            *("--output", str(converted.parent / "evaluation"), "--set", "runtime=onnxruntime"),
        ),
        "convert": run_command(entry_point("convert"), str(MODEL), str(converted)),
        "fetch_weights": run_command(
            *(entry_point("fetch_weights"), "n", "--dir", str(converted.parent)),
            *("--url", "http://weights.test/{size}.pt"),
            code=1,
        ),
        "control": run_command(sys.executable, "-c", CONTROL, code=1),
    }
    converted.parent.mkdir()
    told = {}
    for name, run in trials.items():
        home = folder / name
        variables = environment(DOMAIN) | {variable: str(home / part) for variable, part in FOLDERS.items()}
        variables.pop("ORT_DISABLE_TELEMETRY", None)  # else it would come from the test
        for part in FOLDERS.values():
            (home / part).mkdir(parents=True)
        os.chdir(home)
        before = connections()
        run(variables)
        told[name] = connections() - before, destinations(recorder), written(home)
    print(json.dumps(told))  # noqa: T201


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_command_sends_and_writes_what_the_page_on_security_says(tmp_path: Path) -> None:
    for runtime in ("onnxruntime", "openvino"):
        if importlib.util.find_spec(runtime) is None:
            pytest.skip(f"no {runtime}: make install")
    if missing := [name for name in ("unshare", "ip", "mount") if shutil.which(name) is None]:
        pytest.skip(f"needs {', '.join(missing)} (util-linux, iproute2)")
    trial = [*ALONE, "sh", "-c", "mount -t tmpfs none /dev/shm && ip link add cable type veth"]
    refused = subprocess.run(trial, capture_output=True, text=True)
    if refused.returncode != 0:
        pytest.skip(f"this machine allows no network namespaces: {refused.stderr.strip()}")
    image = REPOSITORY / "docs" / "images" / "annotated.png"
    run = subprocess.run(
        [*ALONE, sys.executable, "-W", "ignore", __file__, str(tmp_path), str(image)],
        env=environment(DOMAIN) | SUPPORT_PATH,
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert run.returncode == 0, run.stderr
    told: dict[str, tuple[int, list[str], list[str]]] = json.loads(run.stdout)
    assert told.keys() == EXPECTED.keys()
    for name, (opened, sent_to, patterns) in EXPECTED.items():
        *connected, files = told[name]
        assert connected == [opened, sent_to], name
        assert len(files) == len(patterns), (name, files)
        assert all(map(re.fullmatch, patterns, files)), (name, files)


if __name__ == "__main__":
    main()
