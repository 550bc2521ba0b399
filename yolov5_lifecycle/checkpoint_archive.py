"""The zip archive that torch.save writes, looked at before torch sees it."""

from __future__ import annotations

import io
import zipfile

from yolov5_lifecycle.model import WeightsError

MAX_RECORDS = 20_000
MAX_PICKLE_BYTES = 64 << 20
"""data.pkl of yolov5n has 83 kB, of an unstripped x6 a few hundred."""

_SIGNATURES = {
    b"<!DO": "an HTML page: the download went wrong",
    b"<htm": "an HTML page: the download went wrong",
    b"vers": "a Git LFS pointer: run `git lfs pull`",
    b"\x80\x02\x8a\n": "a checkpoint saved by torch before 1.6",
    b"\x08\x07\x12\x07": "an ONNX model",
    b"\x08\x08\x12\x07": "an ONNX model",
}


def check_archive(data: bytes) -> None:
    """Raise WeightsError unless `data` is a whole, plain zip archive of one pickle and its storages.

    Only a zip keeps torch.load off its older formats. torch never compresses a record, so a compressed one is
    foreign.
    """
    if not data:
        raise WeightsError("the file is empty")
    if data[:4] != b"PK\x03\x04":
        found = _SIGNATURES.get(data[:4], f"something that begins with {data[:4]!r}")
        raise WeightsError(f"expected a PyTorch checkpoint (a zip archive), found {found}")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            _check_records(archive.infolist(), len(data))
            damaged = archive.testzip()
    except (
        zipfile.BadZipFile,
        NotImplementedError,
        RuntimeError,
        EOFError,
        ValueError,
        OverflowError,
    ) as error:
        if isinstance(error, WeightsError):
            raise
        raise WeightsError(
            f"the archive is damaged or cut short ({error}): copy or download it again"
        ) from None
    if damaged is not None:
        raise WeightsError(f"the record {damaged[:80]!r} is damaged: copy or download the file again")


def _check_records(records: list[zipfile.ZipInfo], file_bytes: int) -> None:
    names = [record.filename for record in records]
    if len(names) > MAX_RECORDS or len(set(names)) != len(names):
        raise WeightsError(f"the archive has {len(names)} records, some of them twice or far too many")
    for record in records:
        if record.compress_type != zipfile.ZIP_STORED or record.flag_bits & 1:
            raise WeightsError(
                f"the record {record.filename[:80]!r} is compressed or encrypted, as torch never does"
            )
        if record.filename.startswith("/") or ".." in record.filename.split("/"):
            raise WeightsError(f"the record name {record.filename[:80]!r} leaves the archive")
    if sum(record.file_size for record in records) > file_bytes:
        raise WeightsError("the records of the archive overlap: they claim more bytes than the file has")
    if any(name.endswith("/constants.pkl") for name in names):
        raise WeightsError(
            "this is a TorchScript archive: export it from the original .pt, which is what is needed"
        )
    pickles = [record for record in records if record.filename.endswith("/data.pkl")]
    if len(pickles) != 1 or pickles[0].file_size > MAX_PICKLE_BYTES:
        raise WeightsError(
            f"expected one data.pkl of at most {MAX_PICKLE_BYTES >> 20} MiB, found {len(pickles)}"
        )
