"""The zip archive that torch.save writes, looked at before torch sees it."""

from __future__ import annotations

import io
import zipfile
from typing import NamedTuple

from yolov5_lifecycle.model import WeightsError, first_line, shown

MAX_RECORDS = 20_000
MAX_PICKLE_BYTES = 4 << 20
"""data.pkl of yolov5n has 83 kB, of a training checkpoint of x6 with optimizer about 1 MB."""

_PICKLE = "data.pkl"
_FOREIGN_FILES = {
    b"version https://git-lfs": "a Git LFS pointer; run `git lfs pull`",
    b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19": "a checkpoint saved by torch before 1.6; save it again",
    b"\x80": "a bare pickle, which could run anything; do not trust it",
    b"\x08": "what looks like an ONNX model; use the .pt that it was exported from",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"Rar!": "a RAR archive; unpack it first",
    b"7z\xbc\xaf": "a 7-Zip archive; unpack it first",
}


class Archive(NamedTuple):
    """A checkpoint's records, checked. `data` is an archive written anew, so torch reads nothing else."""

    pickle: bytes
    data: bytes


def read_archive(data: bytes) -> Archive:
    """The pickle and the storages in the bytes of a checkpoint.

    Every record is whole (CRC) and stored plainly: torch never compresses, so a compressed one is foreign.
    Raises WeightsError.
    """
    if not data.startswith(b"PK\x03\x04"):
        raise WeightsError(f"expected a PyTorch checkpoint (a zip archive), {_foreign(data)}")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            folder = _check_records(archive.infolist(), len(data))
            return _rewritten(archive, folder)
    except WeightsError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever a hostile archive provokes is a refusal
        raise WeightsError(
            f"the archive is damaged or cut short ({first_line(error)}): copy or download it again"
        ) from None


def _foreign(data: bytes) -> str:
    if not data:
        return "the file is empty"
    if data.count(0) == len(data):
        return "the file is all zeros: copy or download it again"
    if data[:512].lstrip().lower().startswith((b"<!doctype", b"<html", b"<?xml")):
        return "found an HTML page: the download went wrong"
    for signature, kind in _FOREIGN_FILES.items():
        if data.startswith(signature):
            return f"found {kind}"
    if data[257:262] == b"ustar":
        return "found a tar archive, as torch before 1.6 wrote; save the model again with a newer torch"
    return f"found something that begins with {data[:4]!r}"


def _check_records(records: list[zipfile.ZipInfo], file_bytes: int) -> str:
    """The folder that all records lie in."""
    sizes = {record.filename: record.file_size for record in records}
    if len(records) > MAX_RECORDS:
        raise WeightsError(f"the archive has {len(records)} records, at most {MAX_RECORDS} are read")
    if len(sizes) != len(records):
        raise WeightsError("the archive has two records of one name")
    for record in records:
        _check_record(record)
    if sum(sizes.values()) > file_bytes:
        raise WeightsError("the records of the archive overlap: they claim more bytes than the file has")
    folders = sorted({name.partition("/")[0] for name in sizes})
    if len(folders) != 1 or f"{folders[0]}/{_PICKLE}" not in sizes:
        raise WeightsError(
            f"expected a PyTorch checkpoint, found another zip archive, with {shown(list(sizes)[:3])}"
        )
    if f"{folders[0]}/constants.pkl" in sizes:
        raise WeightsError("this is a TorchScript archive: use the .pt that it was exported from")
    if (size := sizes[f"{folders[0]}/{_PICKLE}"]) > MAX_PICKLE_BYTES:
        raise WeightsError(f"{_PICKLE} has {size} bytes, at most {MAX_PICKLE_BYTES} are read")
    return folders[0]


def _check_record(record: zipfile.ZipInfo) -> None:
    name = shown(record.filename)
    if record.filename.startswith("/") or {"..", "."} & set(record.filename.replace("\\", "/").split("/")):
        raise WeightsError(f"the record name {name} leaves the archive")
    if record.flag_bits & 1:
        raise WeightsError(f"the record {name} is encrypted, as torch never does")
    if record.compress_type != zipfile.ZIP_STORED or record.file_size != record.compress_size:
        raise WeightsError(f"the record {name} is compressed, as torch never does")


def _rewritten(archive: zipfile.ZipFile, folder: str) -> Archive:
    """What torch needs, copied: two readers of one odd archive may see two different things in it."""
    pickle = archive.read(f"{folder}/{_PICKLE}")
    copy = io.BytesIO()
    with zipfile.ZipFile(copy, "w", zipfile.ZIP_STORED) as clean:
        for record in archive.infolist():
            name = record.filename.removeprefix(f"{folder}/")
            content = archive.read(record)  # checks the CRC
            if name in (_PICKLE, "byteorder", "version") or name.startswith("data/"):
                clean.writestr(f"archive/{name}", content)
    return Archive(pickle, copy.getvalue())
