"""The zip archive written by torch.save, with its records validated before they are read."""

from __future__ import annotations

import io
import zipfile

from yolov5_lifecycle.models.model import WeightsError, first_line, shown

MAX_RECORDS = 20_000
MAX_DIRECTORY_BYTES = 2 << 20
"""Names and other fields of all records; 20,000 of torch have half of it. zipfile is slow on large fields."""

PICKLE = "data.pkl"
_DIRECTORY_ENTRY = b"PK\x01\x02"
_LENGTHS = (28, 30, 32)
"""Where an entry has the lengths of its name, its extra fields and its comment."""
_ENCRYPTED = 1 | 1 << 6 | 1 << 13
"""Flags of a record: encrypted, strongly encrypted, encrypted directory."""
_BEFORE_ZIP = b"\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19"
"""How the first pickle of the format of torch before 1.6 begins, in any protocol."""
_FOREIGN_FILES = {
    b"version https://git-lfs": "a Git LFS pointer; run `git lfs pull`",
    b"\x80": "a bare pickle, which could run any code; do not trust it",
    b"\x08": "what looks like an ONNX model; give it a name that ends in .onnx",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"Rar!": "a RAR archive; unpack it first",
    b"7z\xbc\xaf": "a 7-Zip archive; unpack it first",
}


class Archive:
    """Records of a checkpoint with validated names and sizes. Created by `read_archive`."""

    def __init__(self, archive: zipfile.ZipFile, folder: str) -> None:
        self._archive = archive
        self._folder = folder
        self._storages: dict[str, bytearray] = {}

    def has(self, name: str) -> bool:
        """Whether there is a record named `name`."""
        return f"{self._folder}/{name}" in self._archive.NameToInfo

    def storage_bytes(self, key: str) -> int:
        """The size of the storage `key`; raises WeightsError if there is no such storage."""
        if not self.has(f"data/{key}"):
            raise WeightsError(f"the storage {shown(key)} is missing: copy or download the file again")
        return self._archive.getinfo(f"{self._folder}/data/{key}").file_size

    def storage(self, key: str) -> bytearray:
        """The writable bytes of the storage `key`, read once and checked against their CRC.

        However many tensors are views of them, they take no more memory than the file. Raises WeightsError.
        """
        if key not in self._storages:
            self._storages[key] = bytearray(self.record(f"data/{key}"))
        return self._storages[key]

    def record(self, name: str, most_bytes: int = -1) -> bytes:
        """The bytes of a record with their CRC checked, or the first `most_bytes`; raises WeightsError."""
        try:
            with self._archive.open(f"{self._folder}/{name}") as content:
                return content.read(most_bytes)
        except Exception as error:  # noqa: BLE001 - any error of a hostile archive means rejection
            raise _damaged(error) from None


def read_archive(data: bytes) -> Archive:
    """The archive in the bytes of a checkpoint; no record content is read yet.

    Rejects compressed records: torch never compresses. Raises WeightsError.
    """
    if not data.startswith(b"PK\x03\x04"):
        raise WeightsError(f"expected a PyTorch checkpoint (a zip archive), {_foreign(data)}")
    _check_directory(data)
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        folder = _check_records(archive.infolist(), len(data))
    except WeightsError:
        raise
    except Exception as error:  # noqa: BLE001 - any error of a hostile archive means rejection
        raise _damaged(error) from None
    return Archive(archive, folder)


def _check_directory(data: bytes) -> None:
    """Before zipfile reads it, which creates an object for each entry: a file has room for 46 million.

    Bytes of a tensor may look like an entry, too.
    """
    if (entries := data.count(_DIRECTORY_ENTRY)) > 2 * MAX_RECORDS:
        raise WeightsError(f"the archive has {entries} records, at most {MAX_RECORDS} are read")
    place, fields_bytes = data.find(_DIRECTORY_ENTRY), 0
    while place >= 0:
        fields_bytes += sum(int.from_bytes(data[place + at : place + at + 2], "little") for at in _LENGTHS)
        place = data.find(_DIRECTORY_ENTRY, place + 1)
    if fields_bytes > MAX_DIRECTORY_BYTES:
        raise WeightsError(
            f"the names and fields of its records have {fields_bytes} bytes, at most {MAX_DIRECTORY_BYTES} "
            "are read"
        )


def _damaged(error: Exception) -> WeightsError:
    return WeightsError(
        f"the archive is damaged or cut short ({first_line(error)}): copy or download it again"
    )


def _foreign(data: bytes) -> str:
    if not data:
        return "the file is empty"
    if data.count(0) == len(data):
        return "the file is all zeros: copy or download it again"
    if data[:512].lstrip().lower().startswith((b"<!doctype", b"<html", b"<?xml")):
        return "found an HTML page: the download went wrong"
    if data.startswith(b"\x80") and _BEFORE_ZIP in data[:32]:
        return "found a checkpoint in the format of torch before 1.6; save it again with a newer torch"
    for signature, kind in _FOREIGN_FILES.items():
        if data.startswith(signature):
            return f"found {kind}"
    if data[257:262] == b"ustar":
        return "found a tar archive, written by torch before 1.6; save the model again with a newer torch"
    return f"found a file that begins with {data[:4]!r}"


def _check_records(records: list[zipfile.ZipInfo], file_bytes: int) -> str:
    """The top-level folder of all records."""
    sizes = {record.filename: record.file_size for record in records}
    if len(records) > MAX_RECORDS:
        raise WeightsError(f"the archive has {len(records)} records, at most {MAX_RECORDS} are read")
    if len(sizes) != len(records):
        raise WeightsError("the archive has two records of one name")
    if any(name.endswith("/constants.pkl") for name in sizes):  # first: torch.jit compresses some records
        raise WeightsError(
            "this is a TorchScript archive, which holds a program: use the .pt that it was exported from, or "
            "an .onnx exported from that"
        )
    for record in records:
        _check_record(record)
    if sum(sizes.values()) > file_bytes:
        raise WeightsError("the records of the archive overlap: they claim more bytes than the file has")
    folders = sorted({name.partition("/")[0] for name in sizes})
    if len(folders) != 1 or f"{folders[0]}/{PICKLE}" not in sizes:
        raise WeightsError(
            f"expected a PyTorch checkpoint, found another zip archive, with {shown(list(sizes)[:3])}"
        )
    return folders[0]


def _check_record(record: zipfile.ZipInfo) -> None:
    name = shown(record.filename)
    if record.filename.startswith("/") or {"..", "."} & set(record.filename.replace("\\", "/").split("/")):
        raise WeightsError(f"the record name {name} leaves the archive")
    if record.flag_bits & _ENCRYPTED:
        raise WeightsError(f"the record {name} is encrypted, which torch.save never does")
    if record.compress_type != zipfile.ZIP_STORED or record.file_size != record.compress_size:
        raise WeightsError(f"the record {name} is compressed, which torch.save never does")
