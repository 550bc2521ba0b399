"""Whether a written .mp4 or .avi file is complete: OpenCV's writer reports no error when the disk is full.

The frames that OpenCV finds in the file do not tell either: of a file without its last bytes it may find all.
But both formats are a sequence of chunks that begin with their length, so any missing end shows.
"""

from __future__ import annotations

from pathlib import Path

_HEADER_BYTES = 16
_LENGTH_FOLLOWS = 1
"""In place of the length of an MP4 box: 64 bits behind its name have it."""


def is_whole_video(path: Path) -> bool:
    """Whether the chunks of the .mp4 or .avi file end where it ends, with its index; raises OSError."""
    is_avi = path.suffix.lower() == ".avi"
    length_of = _riff_length if is_avi else _box_length
    size, end, names = path.stat().st_size, 0, []
    with path.open("rb") as file:
        while end < size:
            file.seek(end)
            name, length = length_of(file.read(_HEADER_BYTES))
            if length == 0:  # unknown while it was written
                return False
            names.append(name)
            end += length
    needed = {b"RIFF"} if is_avi else {b"mdat", b"moov"}
    return end == size and needed <= set(names)


def _riff_length(header: bytes) -> tuple[bytes, int]:
    """Name and length of a chunk of an .avi file; files of more than 1 GB have several."""
    length = int.from_bytes(header[4:8], "little")
    return header[:4], length + 8 if length else 0


def _box_length(header: bytes) -> tuple[bytes, int]:
    """Name and length of a box of an .mp4 file."""
    length = int.from_bytes(header[:4], "big")
    return header[4:8], int.from_bytes(header[8:16], "big") if length == _LENGTH_FOLLOWS else length
