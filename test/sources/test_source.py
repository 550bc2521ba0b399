"""Where a camera's images come from: the scene, folders, image and video files, devices."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import pytest
from support import png_builder
from support.compressed_files import claiming_too_much
from support.grey_images import GREYS, grey_folder, grey_video, nearest_grey
from support.hostile_images import HOSTILE_JPEGS

from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.sources.source import open_source


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return grey_folder(tmp_path)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return grey_video(tmp_path / "video.avi")


def greys(source: Path, count: int, *, loop: bool) -> list[int]:
    """The brightness of the first images, to the nearest of GREYS."""
    frames = islice(open_source(str(source), loop=loop).frames, count)
    return [nearest_grey(frame.image) for frame in frames]


@pytest.mark.parametrize(("source", "rate_hz"), [("video", 10.0), ("folder", 30.0)])
def test_files_come_in_order_once_or_again_at_their_rate_and_in_the_size_that_is_asked_for(
    source: str, rate_hz: float, request: pytest.FixtureRequest
) -> None:
    path = request.getfixturevalue(source)
    assert greys(path, 10, loop=False) == [*GREYS]
    assert greys(path, 10, loop=True) == [*GREYS, *GREYS, *GREYS[:2]]
    assert open_source(str(path)).rate_hz == pytest.approx(rate_hz)
    frames = [next(open_source(str(path), size_hw=size_hw).frames) for size_hw in (None, (12, 40))]
    assert [frame.image.size_hw for frame in frames] == [(24, 32), (12, 40)]


def into_a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def test_one_image_is_a_source(folder: Path) -> None:
    assert greys(folder / "10.png", 3, loop=True) == [170, 170, 170]
    assert greys(folder / "10.png", 3, loop=False) == [170]


def test_a_folder_without_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"has no images \(.*\)\.$"):
        open_source(str(tmp_path))
    (tmp_path / "val").mkdir()
    (tmp_path / "train").mkdir()
    with pytest.raises(SourceError, match=f"Name one of the folders in it, such as {tmp_path}/train"):
        open_source(str(tmp_path))


@pytest.mark.parametrize(
    "content",
    [
        pytest.param("this is no video", id="text"),
        pytest.param("ffconcat version 1.0\nfile video.avi\n", id="concat"),
        pytest.param("#EXTM3U\n#EXTINF:1,\nvideo.avi\n#EXT-X-ENDLIST\n", id="HLS"),
        pytest.param("v=0\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 9 RTP/AVP 26\n", id="SDP"),
        pytest.param(png_builder.image(24, 32), id="an image"),
    ],
)
@pytest.mark.parametrize("name", ["text1.mp4", "text1"])
def test_a_list_of_other_files_or_an_image_is_no_video(
    video: Path, name: str, content: str | bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", "threads;1")
    path = video.with_name(name)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(SourceError, match="neither as an image nor as a video"):
        open_source(str(path))
    assert os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] == "threads;1"


@pytest.mark.parametrize(
    "source", ["/\udcff.avi", "rtsp://camera/\udcff", "filesrc location=\udcff ! appsink"]
)
def test_a_path_or_address_that_is_not_utf8_is_refused(source: str) -> None:
    with pytest.raises(SourceError, match="the path or address of a source must be UTF-8; rename it"):
        open_source(source)


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("4711", "Device 4711 cannot be opened"),
        ("/dev/video4711", "Device 4711 cannot be opened.* There "),
        ("/dev/zero", "/dev/zero is a device, but not a camera. There "),
        ("x" * 5000, "is neither 'synthetic'"),
        ("9" * 10, "nor the number of a device"),
    ],
)
def test_a_missing_device_is_refused(source: str, told: str) -> None:
    with pytest.raises(SourceError, match=told):
        open_source(source)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        pytest.param(lambda path: path.write_bytes(b"damaged"), "", id="no image"),
        pytest.param(
            lambda path: path.write_bytes(claiming_too_much()),
            "OpenCV refuses the image: ",
            id="too large a claim",
        ),
        pytest.param(
            lambda path: path.write_bytes(HOSTILE_JPEGS["a large frame behind TEM"][0]),
            "found marker FF01",
            id="a large frame in disguise",
        ),
        pytest.param(lambda path: os.truncate(path, 1 << 30), "found more than 536870912 bytes", id="sparse"),
        pytest.param(into_a_pipe, "found a pipe", id="pipe"),
        pytest.param(lambda path: (path.unlink(), path.mkdir()), "found a folder", id="folder"),
    ],
)
def test_a_damaged_image_of_a_folder_is_skipped_and_reported_once(
    folder: Path, spoil: Callable[[Path], object], told: str
) -> None:
    spoil(folder / "9.png")
    reports: list[str] = []
    frames = islice(open_source(str(folder), report=reports.append).frames, 9)
    assert [nearest_grey(frame.image) for frame in frames] == [grey for grey in GREYS if grey != 90] * 3
    assert len(reports) == 2
    assert re.search(f"skipped: {re.escape(str(folder))}/9.png cannot be read.*{told}", reports[0])
    assert reports[1] == "1 of 4 images were skipped."


@pytest.mark.parametrize("loop", [False, True])
def test_a_folder_without_a_readable_image_ends_with_the_reason(folder: Path, loop: bool) -> None:
    for path in folder.glob("*.png"):
        path.write_bytes(b"damaged")
    with pytest.raises(SourceError, match="None of the 4 images can be read"):
        list(open_source(str(folder), loop=loop).frames)


def test_of_many_damaged_images_only_the_first_are_named(folder: Path) -> None:
    for number in range(20, 40):
        (folder / f"{number}.png").write_bytes(b"damaged")
    reports: list[str] = []
    assert len(list(open_source(str(folder), loop=False, report=reports.append).frames)) == len(GREYS)
    assert all(report.startswith("skipped: ") for report in reports[:10])
    assert reports[10:] == ["20 of 24 images were skipped."]


def test_a_damaged_image_alone_is_refused(folder: Path) -> None:
    (folder / "9.png").write_bytes(b"damaged")
    with pytest.raises(SourceError, match=r"9\.png cannot be read as an image"):
        next(open_source(str(folder / "9.png")).frames)


def test_a_video_that_goes_away_ends_with_the_reason(video: Path) -> None:
    frames = open_source(str(video), loop=True).frames
    assert len(list(islice(frames, len(GREYS)))) == len(GREYS)
    video.unlink()
    with pytest.raises(SourceError, match="can no longer be read"):
        next(frames)
