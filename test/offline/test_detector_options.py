"""Settings of a command: those of a node, or of one of its cameras."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.detected_offline import SET_MODEL, run

from yolov5_lifecycle.offline.detector_options import wanted_settings
from yolov5_lifecycle.settings.schema import SettingsError

CAMERAS = """\
/yolov5:
  ros__parameters:
    cameras: [front, rear]
    classes: [circle]
    front:
      classes: [star]
      max_rate: 5.0
    rear:
      max_rate: 10.0
"""


@pytest.fixture
def parameters(tmp_path: Path) -> Path:
    path = tmp_path / "cameras.yaml"
    path.write_text(CAMERAS)
    return path


@pytest.mark.parametrize(("camera", "classes"), [("front", ("star",)), ("rear", ("circle",))])
def test_the_settings_of_a_camera_are_its_overrides_over_those_of_the_node(
    camera: str, classes: tuple[str, ...], parameters: Path
) -> None:
    settings = wanted_settings(parameters, [], "/yolov5", camera)
    assert settings.classes == classes
    assert not settings.cameras
    assert not settings.overrides


def test_an_override_without_effect_offline_needs_no_camera(tmp_path: Path) -> None:
    path = tmp_path / "rates.yaml"
    path.write_text(CAMERAS.replace("      classes: [star]\n", ""))
    assert wanted_settings(path, [], "/yolov5").classes == ("circle",)


@pytest.mark.parametrize(
    ("camera", "told"),
    [
        pytest.param(
            None,
            "front.classes: it applies to one camera only: give the one that took the images, --camera front "
            "or --camera rear.",
            id="none is chosen",
        ),
        pytest.param("left", "cameras: expected one of front, rear, but --camera is 'left'.", id="another"),
    ],
)
def test_a_camera_that_is_missing_or_unknown_is_refused(
    camera: str | None, told: str, parameters: Path
) -> None:
    with pytest.raises(SettingsError) as refused:
        wanted_settings(parameters, [], "/yolov5", camera)
    assert [str(problem) for problem in refused.value.problems] == [told]


def test_a_camera_needs_parameters_that_name_it() -> None:
    with pytest.raises(SettingsError, match="there are no cameras, but --camera is 'front'"):
        wanted_settings(None, [], "/yolov5", "front")


def test_every_value_that_is_refused_is_named_at_once(parameters: Path) -> None:
    unknown = [f"unknown_{number}=1" for number in range(15)]
    given = ["autostart=true", *unknown, "max_rate=5.0", "confidence_threshold=2.0"]
    with pytest.raises(SettingsError) as refused:
        wanted_settings(None, given, "/yolov5")
    told = [problem.setting for problem in refused.value.problems]
    assert sorted(told) == sorted(assignment.partition("=")[0] for assignment in given)
    with pytest.raises(SettingsError) as refused:
        wanted_settings(parameters, ["lazy=true"], "/yolov5")  # and no camera
    assert [problem.setting for problem in refused.value.problems] == ["lazy", "front.classes"]


def test_a_recording_is_detected_with_the_settings_of_its_camera(
    drive: Path, parameters: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--params-file", str(parameters), "--camera", "front", *SET_MODEL]
    assert run([str(drive), "--output", str(tmp_path / "found"), *words]) == 0
    told = capsys.readouterr().err
    assert ("star " in told, "circle " in told) == (True, False)
