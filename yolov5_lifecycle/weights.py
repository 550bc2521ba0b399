"""Which weights file, and what is in it."""

from __future__ import annotations

import functools
import hashlib
import os
import shlex
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.checkpoint import read_checkpoint
from yolov5_lifecycle.confinement import confined
from yolov5_lifecycle.model import Model, UncheckedError, WeightsError, shown
from yolov5_lifecycle.safetensors_file import read_safetensors

MAX_FILE_BYTES = 2 << 30
_IRREGULAR = "expected a regular file, found a folder, pipe or device"
_READERS: dict[str, Callable[[bytes], Model]] = {
    ".safetensors": read_safetensors,
    ".pt": read_checkpoint,
    ".pth": read_checkpoint,
}


@dataclass(frozen=True, eq=False)
class WeightsFile:
    """A file that was read, the digest of the very bytes that were used, and the model in them."""

    path: Path
    sha256: str
    model: Model


def find_weights(
    *, weights: str, weights_dir: Path, model_size: str, weights_dirs: Sequence[Path] = ()
) -> Path:
    """The file that `weights` names, or the one of `model_size` in `weights_dir`: .safetensors before .pt.

    A leading ~ is the home folder. Raises WeightsError when there is none, and unless the file lies in one of
    `weights_dirs`, if there are any.
    """
    located = functools.partial(confined, folders=weights_dirs) if weights_dirs else expanded
    if weights:
        return located(Path(weights))
    folder = located(weights_dir)
    tried = [folder / f"yolov5{model_size}{suffix}" for suffix in (".safetensors", ".pt")]
    for path in tried:
        if os.path.lexists(path):
            return located(path)
    raise WeightsError(
        f"no weights for model_size '{model_size}': neither {tried[0]} nor {tried[1]} is there. "
        f"`fetch_weights {model_size} --dir {shlex.quote(str(folder))}` downloads the official ones; "
        "in a workspace with `ros2 run yolov5_lifecycle` before it. Or set the parameter `weights` to a path."
    )


def load_weights(path: Path, *, sha256: str = "") -> WeightsFile:
    """Read the file at `path` once and make its model; with `sha256`, only if its bytes have that digest.

    The path in the result has its links resolved. Raises WeightsError with the path in its message,
    UncheckedError when that says nothing of what the file holds.
    """
    try:
        reader = _reader(path)
        data = _read_once(path)
        digest = hashlib.sha256(data).hexdigest()
        if sha256 and digest != sha256.lower():
            raise WeightsError(
                f"its sha256 is {digest}, expected {sha256.lower()}: this is another file; "
                "get the one that is meant, or correct the digest"
            )
        return WeightsFile(Path(os.path.realpath(path)), digest, reader(data))
    except (WeightsError, MemoryError, RuntimeError) as error:
        if is_out_of_memory(error):
            refusal: WeightsError = UncheckedError("there is not enough memory to read it; free some")
        elif isinstance(error, WeightsError):
            refusal = error
        else:
            raise
    # Only here is what the attempt has taken free again.
    raise type(refusal)(f"{path}: {refusal}.")


def expanded(path: Path) -> Path:
    """`path` with a leading ~ as the home folder; raises WeightsError when there is none."""
    try:
        return path.expanduser()
    except RuntimeError:
        raise WeightsError(f"{path}: there is no such home folder; write the path in full.") from None


def is_out_of_memory(error: BaseException | None) -> bool:
    """Whether memory ran out in what led to `error`; torch says so in the words of a RuntimeError.

    The words of others do not count: they may quote the file.
    """
    while error is not None:
        is_told_by_torch = isinstance(error, RuntimeError) and "can't allocate memory" in str(error)
        if isinstance(error, MemoryError) or is_told_by_torch:
            return True
        error = error.__context__
    return False


def _reader(path: Path) -> Callable[[bytes], Model]:
    if "\0" in str(path):
        raise WeightsError("a path holds no NUL character: correct it")
    if os.path.isdir(path):  # noqa: PTH112 - Path.is_dir raises where a folder above cannot be read
        raise WeightsError(f"{_IRREGULAR}: name the file itself")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise WeightsError(f"expected a file that ends in {', '.join(_READERS)}, found {shown(path.suffix)}")
    return reader


def _read_once(path: Path) -> bytes:
    """All bytes of a regular file; what is checked and what is used cannot differ."""
    try:
        with open(path, "rb", opener=_open_without_waiting) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise WeightsError(_IRREGULAR)
            if status.st_size > MAX_FILE_BYTES:
                raise WeightsError(f"the file has {status.st_size} bytes; at most {MAX_FILE_BYTES} are read")
            data = file.read(status.st_size + 1)
    except FileNotFoundError:
        raise WeightsError("there is no such file: check the path for a missing '/' or a typo") from None
    except OSError as error:
        raise UncheckedError(f"the file cannot be read ({error.strerror})") from None
    if len(data) != status.st_size:
        raise UncheckedError("the file changed while it was read: try again when it is complete")
    return data


def _open_without_waiting(path: str, flags: int) -> int:
    """A pipe without a writer would hold a plain open for ever."""
    return os.open(path, flags | os.O_NONBLOCK)
