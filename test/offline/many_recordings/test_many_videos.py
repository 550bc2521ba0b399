"""`detect_bag` over many videos, alone and mixed with recordings, in every format."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin
from support.detected_offline import MODEL, SET_MODEL, run
from support.many_recordings import messages, plan_for, result_of
from support.recorded_scene import COUNT, images, raw, record, video

from yolov5_lifecycle.offline.detect_bag import EXIT_INCOMPLETE, main
from yolov5_lifecycle.offline.export.formats import FORMATS
from yolov5_lifecycle.offline.many_recordings.plan import Plan
from yolov5_lifecycle.offline.many_recordings.results import RECORD_NAME, RecordingResult, finished_before
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.settings.settings import validated

WITHOUT_ROSBAGS = "import sys; sys.modules['rosbags'] = None; "


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with videos, a recording and something else."""
    folder = tmp_path_factory.mktemp("home") / "mixed"
    folder.mkdir()
    video(folder / "monday.avi")
    shutil.copy(folder / "monday.avi", folder / "tuesday.avi")
    record(folder / "drive", [raw(number) for number in range(COUNT)], storage=StoragePlugin.MCAP)
    (folder / "notes.txt").write_text("nothing")
    return folder


@pytest.fixture(scope="module")
def words(mixed: Path) -> list[str]:
    """A command that has ended: it starts a worker, so all tests share it."""
    words = [str(mixed), "--output", str(mixed.parent / "found"), "--jobs", "1", "--track", *SET_MODEL]
    assert main(words) == 0
    return words


def states(output: Path) -> dict[str, str]:
    rows = json.loads((output / "summary.json").read_text())["results"]
    return {row["recording"]: row["state"] for row in rows}


def processed(source: Path, plan: Plan) -> RecordingResult:
    """The result of a worker that is in this process."""
    plan.output.mkdir(exist_ok=True)
    return result_of(SourceRecording(source.stem, source), plan)


@pytest.mark.long
def test_videos_and_recordings_of_a_folder_get_what_single_runs_write(
    words: list[str], mixed: Path, tmp_path: Path
) -> None:
    output, single = mixed.parent / "found", tmp_path / "single.jsonl"
    assert run([str(mixed / "monday.avi"), "--output", str(single), "--track", *SET_MODEL]) == 0
    for name in ("monday", "tuesday"):
        assert {file.name for file in (output / name).iterdir()} == {"detections.jsonl", RECORD_NAME}
        assert (output / name / "detections.jsonl").read_text() == single.read_text()
    assert run([str(mixed / "drive"), "--output", str(tmp_path / "drive"), "--track", *SET_MODEL]) == 0
    assert messages(output / "drive") == messages(tmp_path / "drive")


@pytest.mark.long
def test_a_second_run_skips_videos_and_recordings(words: list[str], mixed: Path) -> None:
    before = {path.name: path.stat().st_ino for path in (mixed.parent / "found").iterdir() if path.is_dir()}
    assert main(words) == 0
    assert states(mixed.parent / "found") == dict.fromkeys(["drive", "monday", "tuesday"], "skipped")
    after = {path.name: path.stat().st_ino for path in (mixed.parent / "found").iterdir() if path.is_dir()}
    assert after == before


@pytest.mark.long
@pytest.mark.parametrize("name", ["monday.avi", "drive"])
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_result_has_the_format_of_the_folder_and_is_not_made_again(
    suffix: str, name: str, mixed: Path, tmp_path: Path
) -> None:
    plan = plan_for(tmp_path / "found", suffix=suffix, crops=True)
    source = SourceRecording(Path(name).stem, mixed / name)
    assert processed(source.path, plan).state == "done"
    folder = plan.output / source.name
    assert {file.name for file in folder.iterdir()} == {f"detections{suffix}", "crops", RECORD_NAME}
    again = finished_before(source, plan)
    assert again is not None
    assert (again.state, again.images) == ("skipped", COUNT)
    crops = list((folder / "crops").rglob("*.jpg"))
    assert len(crops) == sum(again.detections.values()) > COUNT
    crops[0].unlink()
    assert finished_before(source, plan) is None
    assert processed(source.path, plan).state == "done"
    assert crops[0].exists()


def test_crops_lie_in_the_recording_that_is_a_result(mixed: Path, tmp_path: Path) -> None:
    plan = plan_for(tmp_path / "found", crops=True)
    source = SourceRecording("drive", mixed / "drive")
    row = processed(source.path, plan)
    assert messages(plan.output / "drive")
    assert len(list((plan.output / "drive" / "crops").rglob("*.jpg"))) == sum(row.detections.values())
    assert finished_before(source, plan) is not None


def test_the_command_takes_the_format_from_the_name_of_the_folder(
    mixed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "found.csv"
    plan = plan_for(output, suffix=".csv", crops=True)
    assert processed(mixed / "monday.avi", plan).state == "done"
    assert main([str(mixed / "m*.avi"), "--output", str(output), "--crops", *SET_MODEL]) == 0
    assert states(output) == {"monday": "skipped"}


@pytest.mark.parametrize("change", [{"suffix": ".csv"}, {"crops": True}, {"suffix": ".csv", "crops": True}])
def test_another_format_or_crops_replace_a_result(
    change: dict[str, Any], mixed: Path, tmp_path: Path
) -> None:
    plan = plan_for(tmp_path)
    other = plan_for(tmp_path, **change)
    source = SourceRecording("monday", mixed / "monday.avi")
    assert processed(source.path, plan).state == "done"
    assert finished_before(source, other) is None
    assert processed(source.path, other).state == "done"
    assert finished_before(source, plan) is None


def test_formats_and_crops_keep_the_digest_of_results_without_them(tmp_path: Path) -> None:
    values = validated(MODEL | {"precision": "fp32"}).model_dump(mode="json")
    place = {"model_size", "weights", "weights_dir", "weights_dirs", "weights_sha256"}
    settings = {name: value for name, value in values.items() if name not in place}
    before = [settings, {"topic": None, "node": "/yolov5", "images": False, "masks": True}]
    text = json.dumps(before, sort_keys=True)
    plain = plan_for(tmp_path, precision="fp32")
    assert plain.settings_sha256 == hashlib.sha256(text.encode()).hexdigest()
    digests = {
        plan_for(tmp_path, suffix=suffix, crops=crops).settings_sha256
        for suffix in ("", *FORMATS)
        for crops in (False, True)
    }
    assert len(digests) == 2 * (len(FORMATS) + 1)


def test_a_video_that_was_changed_is_processed_again(mixed: Path, tmp_path: Path) -> None:
    source, plan = SourceRecording("monday", tmp_path / "monday.avi"), plan_for(tmp_path / "found")
    shutil.copy(mixed / "monday.avi", source.path)
    assert processed(source.path, plan).state == "done"
    with source.path.open("ab") as file:
        file.write(b"more")
    assert finished_before(source, plan) is None
    assert processed(source.path, plan).state == "done"


def test_a_broken_video_is_set_aside_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    row = processed(tmp_path / "broken.mp4", plan_for(tmp_path / "found"))
    assert row.state == "set aside"
    assert "neither as an image nor as a video" in row.reason
    assert list((tmp_path / "found").iterdir()) == []


@pytest.mark.long
def test_a_worker_for_videos_imports_no_rosbags() -> None:
    program = f"{WITHOUT_ROSBAGS} import yolov5_lifecycle.offline.many_recordings.recording_task"
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.long
def test_a_pattern_of_videos_needs_no_rosbags_and_sets_a_broken_one_aside(
    mixed: Path, tmp_path: Path
) -> None:
    (tmp_path / "videos").mkdir()
    shutil.copy(mixed / "monday.avi", tmp_path / "videos")
    (tmp_path / "videos" / "broken.mp4").write_bytes(b"no video")
    start = "from yolov5_lifecycle.offline.detect_bag import main; sys.exit(main(sys.argv[1:]))"
    program = f"{WITHOUT_ROSBAGS} {start}"
    words = [str(tmp_path / "videos" / "*"), "--output", str(tmp_path / "found"), "--jobs", "1", *SET_MODEL]
    ended = subprocess.run(
        [sys.executable, "-c", program, *words], capture_output=True, text=True, check=False
    )
    assert ended.returncode == EXIT_INCOMPLETE, ended.stderr
    assert states(tmp_path / "found") == {"broken": "set aside", "monday": "done"}
    assert "broken: set aside: " in ended.stderr


@pytest.mark.parametrize("option", [["--images"], ["--topic", "/x"]], ids=["images", "topic"])
def test_what_applies_to_recordings_is_refused_for_videos_alone(
    option: list[str], mixed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main([str(mixed / "*.avi"), "--output", str(tmp_path / "found"), *option])
    assert end.value.code == 2
    assert f"{option[0]} applies to recordings only" in capsys.readouterr().err


def test_a_video_and_a_recording_of_one_name_are_refused(
    mixed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(mixed / "monday.avi", tmp_path / "drive.avi")
    words = [str(mixed / "drive"), str(tmp_path / "drive.avi"), "--output", str(tmp_path / "found")]
    assert main(words) == 1
    assert "1 name(s) belong to several recordings or videos" in capsys.readouterr().err


def test_images_among_many_are_refused_with_the_way_to_use_them(
    mixed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shots = images(tmp_path / "shots")
    assert main([str(mixed), str(shots), "--output", str(tmp_path / "found")]) == 1
    assert "A folder of images is a source of its own: give it alone" in capsys.readouterr().err
