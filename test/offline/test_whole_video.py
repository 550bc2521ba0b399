"""A video without its end is told from a whole one, whatever it claims to contain."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.annotated_files import VideoOutput, is_whole_video

SUFFIXES = pytest.mark.parametrize("suffix", [".avi", ".mp4"])


def written(path: Path, frames: int) -> Path:
    """Frames of noise as `detect_bag` writes them."""
    generator = np.random.default_rng(0)
    output = VideoOutput(path, 12.5)
    for _ in range(frames):
        output.add(ColourImage(generator.integers(0, 256, (48, 64, 3), np.uint8), "bgr"))
    output.finish()
    return path


@SUFFIXES
@pytest.mark.parametrize("frames", [1, 2, 99])
def test_a_whole_video_is_whole(frames: int, suffix: str, tmp_path: Path) -> None:
    assert is_whole_video(written(tmp_path / f"whole{suffix}", frames))


@SUFFIXES
@pytest.mark.parametrize("missing_share", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_a_video_without_its_end_is_not(missing_share: float, suffix: str, tmp_path: Path) -> None:
    path = written(tmp_path / f"cut_off{suffix}", 5)
    size = path.stat().st_size
    os.truncate(path, size - max(1, int(missing_share * size)))
    assert not is_whole_video(path)


@pytest.mark.parametrize(
    ("name", "content", "is_whole"),
    [
        pytest.param("large.avi", b"RIFF\4\0\0\0AVI RIFF\4\0\0\0AVIX", True, id="two chunks"),
        pytest.param("large.avi", b"RIFF\4\0\0\0AVI RIFF\5\0\0\0AVIX", False, id="second cut off"),
        pytest.param("begun.avi", b"RIFF\0\0\0\0AVI " + bytes(50), False, id="length unknown"),
        pytest.param("large.mp4", b"\0\0\0\1mdat" + bytes(7) + b"\x10\0\0\0\x08moov", True, id="64 bits"),
        pytest.param("begun.mp4", b"\0\0\0\0mdat" + bytes(50), False, id="box of unknown length"),
        pytest.param("begun.mp4", b"\0\0\0\x08free\0\0\0\x08mdat", False, id="no index"),
        pytest.param("odd.mp4", b"\0\0", False, id="two bytes"),
    ],
)
def test_the_lengths_of_the_chunks_decide(name: str, content: bytes, is_whole: bool, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    assert is_whole_video(tmp_path / name) == is_whole
