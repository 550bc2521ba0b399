"""Files named .pt that are something else, or archives that torch.save did not write."""

from __future__ import annotations

import functools
import io
import struct
import tarfile
import zipfile
from collections.abc import Callable, Mapping

import torch

from support.checkpoint_builder import official_model, saved, stripped
from support.pickle_assembler import archive, mapping

_PICKLE = "archive/data.pkl"


@functools.cache
def valid(protocol: int = 2) -> bytes:
    return saved(stripped(official_model()), protocol)


def with_pickle(pickle: bytes, whole: bytes = b"") -> bytes:
    return with_record(_PICKLE, pickle, whole)


def with_record(record: str, content: bytes, whole: bytes = b"") -> bytes:
    """The valid archive, or another one, with another record; it is whole, so that this is looked at."""
    file = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(whole or valid())) as old,
        zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, content if name == record else old.read(name))
    return file.getvalue()


@functools.cache
def valid_pickle(protocol: int = 2) -> bytes:
    """The data.pkl of the valid archive."""
    return pickle_of(valid(protocol))


def pickle_of(data: bytes) -> bytes:
    """The data.pkl of an archive."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return archive.read(_PICKLE)


def before_zip() -> bytes:
    """As torch.save still writes it if it is told so."""
    file = io.BytesIO()
    torch.save([1], file, _use_new_zipfile_serialization=False)
    return file.getvalue()


def tar() -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as packed:
        packed.addfile(tarfile.TarInfo("storages"))
    return file.getvalue()


def one_bit_flipped() -> bytes:
    data = bytearray(valid())
    data[len(data) // 2] ^= 0x10
    return bytes(data)


def with_flag(flag: int) -> bytes:
    """All records of an archive marked with a general purpose flag, in both places."""
    data = bytearray(archive(mapping({})))
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = data.find(signature)
        while place >= 0:
            data[place + offset] |= flag
            place = data.find(signature, place + 1)
    return bytes(data)


def overlapping(count: int) -> bytes:
    """An archive whose directory names the bytes of one record `count` times."""
    content = bytes(1 << 20)
    pieces = archive(mapping({}), storages=[content])
    with zipfile.ZipFile(io.BytesIO(pieces)) as zipped:
        record, end = zipped.getinfo("archive/data/0"), zipped.start_dir
    names = [f"archive/data/{index}".encode() for index in range(count)]
    fixed = (b"PK\x01\x02", 20, 20, 0, 0, 0, 33, record.CRC, len(content), len(content))
    rest = (0, 0, 0, 0, 0, record.header_offset)
    directory = b"".join(struct.pack("<4s6H3L5H2L", *fixed, len(name), *rest) + name for name in names)
    ending = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, count, count, len(directory), end, 0)
    return pieces[:end] + directory + ending


def with_twins() -> bytes:
    """Two records of one name, which zipfile would warn of."""
    data = archive(mapping({}), more=[("archive/data/7", b"x"), ("archive/data/8", b"x")])
    return data.replace(b"archive/data/8", b"archive/data/7")


def with_large_fields() -> bytes:
    """Records with 64 kB of empty fields each, over which zipfile takes longer than over the rest."""
    file = io.BytesIO(archive(mapping({})))
    with zipfile.ZipFile(file, "a") as zipped:
        for index in range(33):
            record = zipfile.ZipInfo(f"archive/data/1{index}")
            record.extra = bytes.fromhex("99990000") * 16_383
            zipped.writestr(record, b"")
    return file.getvalue()


def torchscript() -> bytes:
    """Its code is compressed."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as zipped:
        zipped.writestr("model/data.pkl", b"\x80\x02}.")
        zipped.writestr("model/code/__torch__.py", "pass" * 100, compress_type=zipfile.ZIP_DEFLATED)
        zipped.writestr("model/constants.pkl", b"\x80\x02).")
    return file.getvalue()


def two_endings() -> bytes:
    """The directory that zipfile finds is another one than that which the end of the file points to."""
    data = archive(mapping({}))
    size, start = struct.unpack("<2L", data[-10:-2])
    return data[:-22] + data[start : start + size] + data[-22:]


ARCHIVES: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "the file is empty"),
    "only zeros": (lambda: bytes(1000), "all zeros"),
    "HTML page after blanks": (lambda: b"\n  <HTML>", "an HTML page"),
    "Git LFS pointer": (lambda: b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
    "bare pickle": (lambda: b"\x80\x02cos\nsystem\n(X\x04\x00\x00\x00truetR.", "a bare pickle"),
    "torch before 1.6": (before_zip, "in the format of torch before 1.6; save it again"),
    "tar of old torch": (tar, "a tar archive"),
    "ONNX": (lambda: b"\x08\x07\x12\x07pytorch", "ONNX"),
    "gzip": (lambda: b"\x1f\x8b\x08\x00", "a gzip file"),
    "7-Zip": (lambda: b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive"),
    "text": (lambda: b"hello", "begins with b'hell'"),
    "first half of a file": (lambda: valid()[: len(valid()) // 2], "cut short"),
    "one bit flipped": (one_bit_flipped, "Bad CRC-32"),
    "compressed": (lambda: archive(mapping({}), compression=zipfile.ZIP_DEFLATED), "is compressed"),
    "encrypted": (lambda: with_flag(1), "is encrypted"),
    "records with 2 MiB of fields": (with_large_fields, "the names and fields of its records have 2"),
    "another byte order": (lambda: with_record("archive/byteorder", b"big"), "in the byte order"),
    "byte order of 30 MiB": (lambda: with_record("archive/byteorder", bytes(30 << 20)), "in the byte order"),
    "overlapping records": (lambda: overlapping(1000), "overlap"),
    "25,000 records": (lambda: archive(mapping({}), storages=[b""] * 25_000), "has 25003 records"),
    "60,000 records": (lambda: overlapping(60_000), "has 60000 records"),
    "two records of one name": (with_twins, "two records of one name"),
    "name that leaves the archive": (
        lambda: archive(mapping({}), more=[("archive/../../etc/evil", b"x")]),
        "leaves the archive",
    ),
    "absolute name": (lambda: archive(mapping({}), more=[("/etc/evil", b"x")]), "leaves the archive"),
    "two folders": (lambda: archive(mapping({}), more=[("other/data.pkl", b"x")]), "another zip archive"),
    "TorchScript as torch.jit.save writes it": (torchscript, "this is a TorchScript archive"),
    "a directory twice": (two_endings, "damaged or cut short"),
}
