"""Command `fetch_weights MODEL`: download an official checkpoint to the folder the detector loads it from."""

from __future__ import annotations

import argparse
import errno
import fcntl
import os
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from yolov5_lifecycle.checkpoints.locate import MAX_FILE_BYTES, WeightsFile, expanded, load_weights
from yolov5_lifecycle.commands.convert import convert, report
from yolov5_lifecycle.commands.download import DownloadError, Progress, download
from yolov5_lifecycle.commands.fetch_weights_arguments import LICENCE, command_parser
from yolov5_lifecycle.commands.official_weights import SHA256, URL
from yolov5_lifecycle.models.model import UncheckedError, WeightsError
from yolov5_lifecycle.printable import in_one_line, shell_command
from yolov5_lifecycle.process.standard_streams import complain, show_progress, write_output
from yolov5_lifecycle.unfinished import open_itself

_STALL_S = 30.0
_UNFINISHED = ".partial.pt"
_IRREGULAR = "{}: expected a regular file, found a link, pipe or device: remove it"


def fetch(
    model: str,
    folder: Path,
    *,
    url: str = URL,
    sha256: str = "",
    stall_s: float = _STALL_S,
    progress: Progress = lambda done_bytes, total_bytes: None,
) -> WeightsFile:
    """Load yolov5`model`.pt from `folder`, downloading it if it does not exist.

    `url` contains the placeholder `{size}`. The resulting file is complete, readable and, with `sha256`, has
    that digest. An unfinished or unchecked download is kept beside it and resumed by the next call; one with
    another digest or without a model is removed. Raises DownloadError, WeightsError or OSError.
    """
    target = folder / f"yolov5{model}.pt"
    if os.path.lexists(target):
        return load_weights(target, sha256=sha256)
    if "{size}" not in url:
        raise DownloadError(f"{url}: expected an address with {{size}} in it, as in {URL}")
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        return _downloaded(url.replace("{size}", model), target, sha256, stall_s, progress)


def _downloaded(url: str, target: Path, sha256: str, stall_s: float, progress: Progress) -> WeightsFile:
    unfinished = target.with_suffix(_UNFINISHED)
    found = _whole(unfinished, sha256)
    if found is None:
        try:
            _append(url, unfinished, stall_s, progress)
        except DownloadError as error:
            otherwise = f"Or copy {target.name} into {target.parent} by other means."
            raise DownloadError(f"{error}. {otherwise}") from None
        found = _checked(unfinished, url, sha256)
    unfinished.replace(target)
    return replace(found, path=target.resolve())


def _append(url: str, unfinished: Path, stall_s: float, progress: Progress) -> None:
    with _opened(unfinished) as file:
        try:
            download(url, file, max_bytes=MAX_FILE_BYTES, stall_s=stall_s, progress=progress)
            file.flush()
            os.fsync(file.fileno())
        except BaseException:
            if os.fstat(file.fileno()).st_size == 0:  # nothing to resume
                unfinished.unlink(missing_ok=True)
            raise


def listing(folder: Path) -> str:
    """The weights files in `folder`, one per line with its size; unfinished downloads are marked."""
    files = sorted(path for suffix in (".pt", ".safetensors", ".onnx") for path in folder.glob(f"*{suffix}"))
    if not files:
        command = shell_command("fetch_weights", "n", "--dir", folder)
        return f"no weights in {folder}; `{command}` downloads the smallest.\n"
    return "".join(
        f"{path.stat().st_size / 1e6:8.1f} MB  {in_one_line(str(path))}"
        f"{'  (unfinished: fetch it again)' if path.name.endswith(_UNFINISHED) else ''}\n"
        for path in files
        if path.is_file()
    )


def main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)
    if arguments.list == (arguments.model is not None):
        parser.error("give a MODEL, or --list")
    try:
        summary = _run(arguments)
    except (DownloadError, WeightsError, OSError) as error:
        complain("fetch_weights", in_one_line(str(error)))
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("\n")  # ends the line of the progress bar
        complain("fetch_weights", "interrupted; run the command again to resume the download")
        return 130
    return write_output("fetch_weights", summary)


def _run(arguments: argparse.Namespace) -> str:
    """Run the command and return its output."""
    folder = expanded(arguments.dir)
    if arguments.list:
        return listing(folder)
    sys.stderr.write(LICENCE)
    found = _fetch_checked(arguments, folder)
    told = "" if arguments.sha256 else _official_line(arguments.model)
    if arguments.safetensors:
        found = convert(found.path, found.path.with_suffix(".safetensors"), overwrite=True)
    return report(found) + told


def _fetch_checked(arguments: argparse.Namespace, folder: Path) -> WeightsFile:
    """The file with the digest that the user has given, or else that of the official file if it is known."""
    model, official = arguments.model, SHA256.get(arguments.model, "")
    sha256 = arguments.sha256 or official
    try:
        return fetch(model, folder, url=arguments.url, sha256=sha256, progress=_show_bytes)
    except WeightsError as error:
        if arguments.sha256 or f"expected {official or None}" not in str(error):
            raise
        raise WeightsError(
            f"{error} The expected digest is that of yolov5{model}.pt in release v7.0: for another file that "
            "you trust, give its digest with --sha256."
        ) from None


def _official_line(model: str) -> str:
    if model in SHA256:
        return f"official    yes, by its sha256: yolov5{model}.pt of release v7.0\n"
    return f"official    not checked: the sha256 of yolov5{model}.pt is not known here; --sha256 checks it\n"


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Lock `folder` against concurrent downloads, which would corrupt a shared file."""
    with _opened(folder / ".fetch_weights.lock") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DownloadError(
                f"another fetch_weights is running in {folder}: wait until it has finished"
            ) from None
        yield


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Open a file for appending, creating it if needed; raises DownloadError for a link, pipe or device."""
    try:
        with open(path, "ab", opener=open_itself) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise DownloadError(_IRREGULAR.format(path))
            yield file
    except OSError as error:
        if error.filename == str(path) and error.errno in (errno.ELOOP, errno.ENXIO):
            raise DownloadError(_IRREGULAR.format(path)) from None
        raise


def _whole(path: Path, sha256: str) -> WeightsFile | None:
    """The complete download of an earlier call that could not check it; None if there is none."""
    try:
        return load_weights(path, sha256=sha256) if path.exists() else None
    except UncheckedError:
        raise
    except WeightsError:
        return None


def _checked(path: Path, url: str, sha256: str) -> WeightsFile:
    """The downloaded model; an invalid file is removed, since it cannot be resumed."""
    try:
        return load_weights(path, sha256=sha256)
    except UncheckedError as error:
        raise UncheckedError(f"{error} The download is kept: then run the command again.") from None
    except WeightsError as error:
        reason = _reason(path, error)
        path.unlink()
        raise WeightsError(f"{url}: {str(reason).removeprefix(f'{path}: ')} It was removed.") from None


def _reason(path: Path, error: WeightsError) -> WeightsError:
    """Why the file at `path` is no model, as a login page is none: that says more than its digest."""
    try:
        load_weights(path)
    except WeightsError as other:
        return other
    return error


def _show_bytes(done_bytes: int, total_bytes: int | None) -> None:
    of_total = f" of {total_bytes / 1e6:.1f}" if total_bytes else ""
    show_progress(f"{done_bytes / 1e6:.1f}{of_total} MB", done=done_bytes == total_bytes)
