"""Command `fetch_weights SIZE`: an official checkpoint into the folder where the detector looks for it."""

from __future__ import annotations

import argparse
import fcntl
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from yolov5_lifecycle.architecture import SIZES
from yolov5_lifecycle.convert import convert, report
from yolov5_lifecycle.download import DownloadError, Progress, download
from yolov5_lifecycle.model import UncheckedError, WeightsError
from yolov5_lifecycle.progress import show_progress
from yolov5_lifecycle.settings import Settings, SettingsError, validated
from yolov5_lifecycle.weights import MAX_FILE_BYTES, WeightsFile, expanded, load_weights

URL = "https://github.com/ultralytics/yolov5/releases/download/v7.0/yolov5{size}.pt"
URL_VARIABLE = "YOLOV5_WEIGHTS_URL"
_LICENCE = "The official YOLOv5 weights are by Ultralytics, under AGPL-3.0 or a licence bought from them.\n"
_STALL_S = 30.0
_UNFINISHED = ".partial.pt"


def fetch(
    size: str,
    folder: Path,
    *,
    url: str = URL,
    sha256: str = "",
    stall_s: float = _STALL_S,
    progress: Progress = lambda done_bytes, total_bytes: None,
) -> WeightsFile:
    """The checkpoint yolov5`size`.pt in `folder`, downloaded unless it is there.

    `url` has `{size}` in it, which is filled in. What lies there afterwards is whole, readable and, with
    `sha256`, has that digest. A download that is unfinished or could not be checked is kept beside it, and
    the next call goes on from there; one with another digest or without a model in it is removed.
    Raises DownloadError, WeightsError or OSError.
    """
    target = folder / f"yolov5{size}.pt"
    if os.path.lexists(target):
        return load_weights(target, sha256=sha256)
    if "{size}" not in url:
        raise DownloadError(f"{url}: expected an address with {{size}} in it, as in {URL}")
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        return _downloaded(url.replace("{size}", size), target, sha256, stall_s, progress)


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
    with unfinished.open("ab") as file:
        download(url, file, max_bytes=MAX_FILE_BYTES, stall_s=stall_s, progress=progress)
        file.flush()
        os.fsync(file.fileno())


def listing(folder: Path) -> str:
    """The weights files in `folder`, one a line with its size; unfinished downloads are marked."""
    files = sorted(path for suffix in (".pt", ".safetensors") for path in folder.glob(f"*{suffix}"))
    if not files:
        return f"no weights in {folder}; `fetch_weights n --dir {folder}` gets the smallest.\n"
    return "".join(
        f"{path.stat().st_size / 1e6:8.1f} MB  {path}"
        f"{'  (unfinished: fetch it again)' if path.name.endswith(_UNFINISHED) else ''}\n"
        for path in files
        if path.is_file()
    )


def main(argv: Sequence[str] | None = None) -> int:
    parser = _parser()
    arguments = parser.parse_args(argv)
    if arguments.list == (arguments.size is not None):
        parser.error("give a SIZE, or --list")
    try:
        sys.stdout.write(_run(arguments))
    except (DownloadError, WeightsError, OSError) as error:
        sys.stderr.write(f"fetch_weights: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("\nfetch_weights: interrupted; give the command again, it goes on from there\n")
        return 130
    return 0


def _run(arguments: argparse.Namespace) -> str:
    """Do what is asked for; what there is to tell."""
    folder = expanded(arguments.dir)
    if arguments.list:
        return listing(folder)
    sys.stderr.write(_LICENCE)
    found = fetch(arguments.size, folder, url=arguments.url, sha256=arguments.sha256, progress=_show_bytes)
    if arguments.safetensors:
        found = convert(found.path, found.path.with_suffix(".safetensors"), overwrite=True)
    return report(found)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="fetch_weights", description="Download an official YOLOv5 checkpoint. " + _LICENCE
    )
    parser.add_argument("size", nargs="?", choices=SIZES, metavar="SIZE", help=f"one of {', '.join(SIZES)}")
    parser.add_argument("--list", action="store_true", help="only show which weights are in the folder")
    parser.add_argument(
        "--dir",
        type=Path,
        default=Path(Settings().weights_dir),
        help="folder for the file, the detector's parameter weights_dir (default: %(default)s)",
    )
    parser.add_argument(
        "--sha256", type=_digest, default="", metavar="HEX", help="accept only a file with this digest"
    )
    parser.add_argument("--safetensors", action="store_true", help="convert the file to .safetensors as well")
    parser.add_argument(
        "--url",
        default=os.environ.get(URL_VARIABLE) or URL,
        help="address with {size} in it, for a mirror; so is the environment variable "
        f"{URL_VARIABLE} (default: %(default)s)",
    )
    return parser


def _digest(text: str) -> str:
    try:
        return validated({"weights_sha256": text}).weights_sha256
    except SettingsError as error:
        raise argparse.ArgumentTypeError(error.problems[0].message) from None


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Two that append to one file would spoil it."""
    with (folder / ".fetch_weights.lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DownloadError(f"another fetch_weights is at work in {folder}: wait for its end") from None
        yield


def _whole(path: Path, sha256: str) -> WeightsFile | None:
    """What an earlier call downloaded whole but could not check; None when it did not."""
    try:
        return load_weights(path, sha256=sha256) if path.exists() else None
    except UncheckedError:
        raise
    except WeightsError:
        return None


def _checked(path: Path, url: str, sha256: str) -> WeightsFile:
    """What was downloaded, if it is a model; else it is removed, since nothing can be continued from it."""
    try:
        return load_weights(path, sha256=sha256)
    except UncheckedError as error:
        raise UncheckedError(f"{error} The download is kept: then give the command again.") from None
    except WeightsError as error:
        path.unlink()
        raise WeightsError(f"{url}: {str(error).removeprefix(f'{path}: ')} It was removed.") from None


def _show_bytes(done_bytes: int, total_bytes: int | None) -> None:
    of_total = f" of {total_bytes / 1e6:.1f}" if total_bytes else ""
    show_progress(f"{done_bytes / 1e6:.1f}{of_total} MB", done=done_bytes == total_bytes)
