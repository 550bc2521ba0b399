"""What `doctor` examines, in which order, and for how long at most."""

from __future__ import annotations

from pathlib import Path

from yolov5_lifecycle.doctor.examination import Examination

TIME_S = 120.0
"""For all examinations together; the patience of each is meant for this time."""
MOST_CAMERAS = 8
"""The others are not opened."""
_REPORT = "Run `doctor --only {} --time 600`, which waits longer; if that fails, too, report its output."
_FIRST = "Correct the errors above first."
_RUNTIME = (
    "Uninstall the package {}, or set runtime to torch, because `auto` may choose a runtime that hangs."
)
_EXAMINATIONS = (
    Examination("system", "yolov5_lifecycle.doctor.system", 10, _REPORT.format("system")),
    Examination("packages", "yolov5_lifecycle.doctor.python_packages", 30, _REPORT.format("packages")),
    Examination("ros", "yolov5_lifecycle.ros.doctor.environment", 20, f"{_FIRST} {_REPORT.format('ros')}"),
    Examination(
        "driver",
        "yolov5_lifecycle.doctor.nvidia_driver",
        10,
        "Restart the machine; if the driver still does not answer, install it again.",
    ),
    Examination(
        "devices",
        "yolov5_lifecycle.doctor.devices",
        40,
        "Set device to cpu and restart the machine: a GPU that hangs recovers no other way. "
        + _REPORT.format("devices"),
    ),
    *(
        Examination("runtime", "yolov5_lifecycle.doctor.runtimes", 30, _RUNTIME.format(name), name)
        for name in ("onnxruntime", "openvino")
    ),
    Examination(
        "transport",
        "yolov5_lifecycle.ros.doctor.image_transport",
        35,
        f"{_FIRST} {_REPORT.format('transport')}",
    ),
    Examination("node", "yolov5_lifecycle.ros.doctor.node_life", 75, f"{_FIRST} {_REPORT.format('node')}"),
)
NAMES = tuple(dict.fromkeys([*(each.name for each in _EXAMINATIONS), "camera"]))
"""What `--only` takes."""


def planned(root: Path) -> list[Examination]:
    """All examinations in their order; the cameras come last, because several may take their whole time."""
    return [*_EXAMINATIONS, *map(_camera, _cameras(root)[:MOST_CAMERAS])]


def _cameras(root: Path) -> list[str]:
    """The paths /dev/video* of the machine with the root `root`, in order of their numbers."""
    found = [device.name for device in (root / "dev").glob("video[0-9]*")]
    return [f"/dev/{name}" for name in sorted(found, key=lambda name: (len(name), name))]


def _camera(device: str) -> Examination:
    return Examination(
        "camera",
        "yolov5_lifecycle.doctor.cameras",
        10,
        "Plug the camera in again, at another port or without a hub, because it is open but sends nothing.",
        device,
    )
