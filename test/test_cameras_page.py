"""The pages on several cameras have the limits and messages of the code."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.pages import CAMERAS_PAGE, REFERENCE, TROUBLESHOOTING
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW
from yolov5_lifecycle.ros.detector.camera_status import SLOW_S
from yolov5_lifecycle.ros.detector.session import MAX_ABANDONED_SESSIONS, REST_TIMEOUT_S, abandoned
from yolov5_lifecycle.runtimes.networks_by_shape import KEPT_PER_CAMERA, MIN_KEPT
from yolov5_lifecycle.settings.camera_names import MAX_CAMERAS, MAX_NAME_LENGTH, camera_names_rule
from yolov5_lifecycle.settings.settings import SETTINGS, SETTINGS_BY_NAME

NUMBERS = {2: "two", 3: "three", 4: "four"}
FAILURES = SETTINGS_BY_NAME["max_consecutive_failures"].default
HEIGHT, WIDTH = USUAL_SOURCE_HW


@pytest.mark.parametrize(
    ("page", "words"),
    [
        pytest.param(CAMERAS_PAGE, f"images of up to {MAX_CAMERAS} cameras", id="cameras"),
        pytest.param(CAMERAS_PAGE, f"At most {MAX_CAMERAS} cameras.", id="cameras-in-limits"),
        pytest.param(CAMERAS_PAGE, f"at most {MAX_NAME_LENGTH} letters", id="name"),
        pytest.param(TROUBLESHOOTING, camera_names_rule(["2nd"], ()), id="name-refused"),
        pytest.param(CAMERAS_PAGE, f"`max_consecutive_failures` ({FAILURES})", id="failures"),
        pytest.param(CAMERAS_PAGE, f"WARN after {SLOW_S:g} s", id="slow"),
        pytest.param(CAMERAS_PAGE, f"waits for it for {REST_TIMEOUT_S:g} s", id="hung"),
        pytest.param(REFERENCE, abandoned(REST_TIMEOUT_S), id="hung-in-log"),
        pytest.param(
            REFERENCE, f"hangs in {NUMBERS[MAX_ABANDONED_SESSIONS + 1]} abandoned sessions", id="abandoned"
        ),
        pytest.param(
            CAMERAS_PAGE,
            f"{NUMBERS[KEPT_PER_CAMERA]} networks for each camera are kept, at least {NUMBERS[MIN_KEPT]}",
            id="networks",
        ),
        pytest.param(CAMERAS_PAGE, f"for {WIDTH}x{HEIGHT} if there was none", id="usual-size"),
    ],
)
def test_a_page_has_the_limit_of_the_code(page: Path, words: str) -> None:
    assert words.lower() in " ".join(page.read_text().split()).lower()


@pytest.mark.usefixtures("ros_domain")
def test_the_page_shows_the_refusal_of_its_wrong_file(tmp_path: Path) -> None:
    section = CAMERAS_PAGE.read_text().partition("\n## Wrong values\n")[2].partition("\n## ")[0]
    given, told = re.findall(r"^```text\n(.*?)\n```$", section, re.MULTILINE | re.DOTALL)
    file = tmp_path / "wrong.yaml"
    file.write_text(given)
    with ServedNode(Preparations(), arguments=["--ros-args", "--params-file", str(file)]) as served:
        assert not served.transition("configure")
        assert served.status().message == told
        done, remark = served.set(**{"left.max_rate": 5.0})
    assert done
    assert f"*Set parameter successful: {remark}*" in " ".join(section.split())


def test_the_page_names_what_can_be_overridden_for_one_camera() -> None:
    page = " ".join(CAMERAS_PAGE.read_text().split())
    section = page.partition("can be overridden: ")[2].partition(". The others")[0]
    named = set(re.findall(r"`(\w+)`", section))
    assert named <= {setting.name for setting in SETTINGS if setting.per_camera}
    assert len(named) > 5
