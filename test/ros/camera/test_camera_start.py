"""Parameters and sources of the camera: a wrong one ends the process with the reason."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import pytest
from support.camera_info_file import camera_info_url
from support.colcon_workspace import REPOSITORY
from support.detector_process import as_arguments, camera_process
from support.grey_images import grey_folder

from yolov5_lifecycle.ros.camera.settings import SCHEMA, CameraSettings
from yolov5_lifecycle.ros.observer import PATIENCE_S
from yolov5_lifecycle.settings.schema import SettingsError

RAW_QOS = "qos_overrides./image_raw.publisher"


def test_the_page_of_the_camera_lists_its_parameters() -> None:
    section = (REPOSITORY / "docs" / "camera.md").read_text().partition("\n## Parameters\n")[2]
    rows = re.findall(r"^\| `(\w+)` \| `(.*?)` \| (.*) \|$", section.partition("\n## ")[0], re.MULTILINE)
    assert [(name, json.loads(default), text) for name, default, text in rows] == [
        (name, field.default, field.description) for name, field in CameraSettings.model_fields.items()
    ]


def test_a_hanging_source_does_not_delay_the_end(ros_domain: int, tmp_path: Path) -> None:
    hanging = tmp_path / "video.mp4"
    os.mkfifo(hanging)
    with (
        camera_process(ros_domain, "--ros-args", *as_arguments({"source": str(hanging)})) as camera,
        hanging.open("wb"),  # waits until the camera reads
    ):
        assert camera.stop(signal.SIGINT) == 0


def test_images_of_another_size_than_the_calibration_end_the_process_with_the_reason(
    ros_domain: int, tmp_path: Path
) -> None:
    folder = grey_folder(tmp_path)
    arguments = as_arguments({"source": str(folder), "camera_info_url": camera_info_url(folder, 64, 48)})
    with camera_process(ros_domain, "--ros-args", *arguments) as camera:
        assert camera.wait(PATIENCE_S) == 1
    assert "The images are 32 x 24, but camera_info_url has the calibration for 64 x 48" in camera.output


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        pytest.param({"rate": -1.0, "seed": -1}, ["rate: -1.0", "seed: -1"], id="ranges"),
        pytest.param(
            {"source": "/nowhere.mp4", "depth": True},
            ["depth, source: only the source 'synthetic' has depth, not '/nowhere.mp4'"],
            id="depth of a file",
        ),
        pytest.param(
            {"camera_info_url": "package://a/b.yaml", "depth": True},
            ["depth, camera_info_url", "camera of the scene"],
            id="depth and a calibration",
        ),
        pytest.param({"width": 640}, ["width and height go together"], id="one side"),
    ],
)
def test_a_wrong_value_is_explained(parameters: dict[str, object], told: list[str]) -> None:
    with pytest.raises(SettingsError) as refused:
        SCHEMA.validated(CameraSettings().model_dump() | parameters)
    assert all(word in str(refused.value) for word in told), refused.value


@pytest.mark.long
@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        pytest.param({"sorce": "0", "rate": "-1.0"}, ["Did you mean 'source'?", "rate: -1.0"], id="name"),
        pytest.param({f"{RAW_QOS}.deph": 5}, ["Did you mean", f"{RAW_QOS}.depth"], id="quality of service"),
    ],
)
def test_a_wrong_parameter_ends_the_process_with_the_reason(
    ros_domain: int, parameters: dict[str, object], told: list[str]
) -> None:
    with camera_process(ros_domain, "--ros-args", *as_arguments(parameters)) as camera:
        assert camera.wait(PATIENCE_S) == 2
    assert all(word in camera.output for word in told), camera.output
    assert "Traceback" not in camera.output
