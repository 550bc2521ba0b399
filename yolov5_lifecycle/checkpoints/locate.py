"""Finding weights files, in allowed folders only, and loading them."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import stat
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors
from yolov5_lifecycle.models.model import Export, Model, UncheckedError, WeightsError, shown
from yolov5_lifecycle.printable import shell_command

MAX_FILE_BYTES = 2 << 30
_IRREGULAR = "expected a regular file, found a folder, pipe or device"


def _read_export(data: bytes) -> Export:
    """See `read_onnx`, which needs an optional package."""
    try:
        from yolov5_lifecycle.checkpoints.onnx_file import read_onnx
    except ImportError as error:
        raise UncheckedError(
            f"an export to ONNX needs the packages onnx and onnxruntime, or onnx and openvino ({error}): "
            f"install them with {sys.executable} -m pip install onnx onnxruntime"
        ) from None
    return read_onnx(data)


_READERS: dict[str, Callable[[bytes], Model | Export]] = {
    ".safetensors": read_safetensors,
    ".pt": read_checkpoint,
    ".pth": read_checkpoint,
    ".onnx": _read_export,
}
_URL = re.compile(r"(?!package:)([a-z][a-z0-9+.-]+):/+(.*)", re.DOTALL | re.IGNORECASE)
_EXPORTS = {
    ".torchscript": "a TorchScript export, which holds a program",
    ".engine": "a TensorRT export",
    ".trt": "a TensorRT export",
    ".tflite": "a TensorFlow Lite export",
    ".pb": "a TensorFlow export",
    ".mlmodel": "a Core ML export",
    ".xml": "an OpenVINO export",
    ".bin": "an OpenVINO export",
}


@dataclass(frozen=True, eq=False)
class WeightsFile:
    """A weights file: its path, the digest of the loaded bytes, and what they hold."""

    path: Path
    sha256: str
    content: Model | Export

    @property
    def model(self) -> Model:
        """The network, for what computes with its layers; raises WeightsError for an export to ONNX."""
        if isinstance(self.content, Export):
            raise WeightsError(
                f"{self.path}: an export to ONNX is run as it is and has no layers that could be changed, "
                "converted or calibrated: use the .pt that it was exported from."
            )
        return self.content


def find_weights(
    *, weights: str, weights_dir: Path, model_size: str, weights_dirs: Sequence[Path] = ()
) -> Path:
    """Path of the file `weights`, or of `model_size` in `weights_dir`: .safetensors before .pt.

    Expands a leading ~. Raises WeightsError if the file does not exist or is outside `weights_dirs`, unless
    those are empty.
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
        f"`{shell_command('fetch_weights', model_size, '--dir', folder)}` downloads the official ones; "
        "in a workspace with `ros2 run yolov5_lifecycle` before it. Or set the parameter `weights` to a path."
    )


def confined(path: Path, folders: Sequence[Path]) -> Path:
    """`path` with links and `..` resolved, if the result is in or is one of `folders`.

    Expands a leading ~. Raises WeightsError, with the same message whether the file exists or not.
    """
    with contextlib.suppress(RuntimeError, ValueError):  # unknown home folder, NUL character
        # abspath removes `..` lexically: following a link outside the folders would reveal that it exists.
        real = Path(os.path.realpath(os.path.abspath(path.expanduser())))  # noqa: PTH100
        if any(real.is_relative_to(os.path.realpath(folder.expanduser())) for folder in folders):
            return real
    if advice := _url_advice(path):
        raise WeightsError(f"{shown_path(path)}: {advice}.")
    raise WeightsError(
        f"{path}: it does not lie in a folder that weights may come from: {', '.join(map(str, folders))}. "
        "Move it there, or start the process with another `weights_dirs`."
    )


def load_weights(path: Path, *, sha256: str = "") -> WeightsFile:
    """Read the file at `path` once and load what it holds; with `sha256`, only if its bytes have that digest.

    The path in the result has its links resolved. Raises WeightsError with the path in its message,
    UncheckedError if the failure does not depend on the content of the file.
    """
    try:
        reader = _reader(path)
        data = read_once(path)
        digest = _checked_digest(data, sha256) if sha256 else ""
        content = reader(data)
        return WeightsFile(Path(os.path.realpath(path)), digest or hashlib.sha256(data).hexdigest(), content)
    except (WeightsError, MemoryError, RuntimeError) as error:
        if is_out_of_memory(error):
            refusal: WeightsError = UncheckedError("there is not enough memory to read it; free some")
        elif isinstance(error, WeightsError):
            refusal = error
        else:
            raise
    # The memory of the failed attempt is only released here.
    raise type(refusal)(f"{shown_path(path)}: {refusal}.")


def weights_digest(path: Path, *, sha256: str = "") -> str:
    """Digest of the file at `path`, whose model is not loaded; raises WeightsError like `load_weights`."""
    try:
        data = read_once(path)
        return _checked_digest(data, sha256) if sha256 else hashlib.sha256(data).hexdigest()
    except WeightsError as error:
        raise type(error)(f"{shown_path(path)}: {error}.") from None


def shown_path(path: Path) -> str:
    """`path` as the user wrote it: of a URL, Path drops slashes, by which secrets in it are recognised."""
    url = _URL.fullmatch(str(path))
    return f"{url[1]}://{'/' if url[1].lower() == 'file' else ''}{url[2]}" if url else str(path)


def _url_advice(path: Path) -> str:
    """What to do with a path that is a URL; "" for a path."""
    if _URL.fullmatch(str(path)) is None or os.path.lexists(path):
        return ""
    return (
        "this is a URL, and a path is expected: download it, unless it is a file of this machine, and write "
        "the path without file://; `fetch_weights n` downloads an official model, with --url from a mirror"
    )


def expanded(path: Path) -> Path:
    """`path` with a leading ~ expanded; raises WeightsError if there is no such home folder, or for a URL."""
    if advice := _url_advice(path):
        raise WeightsError(f"{shown_path(path)}: {advice}.")
    try:
        return path.expanduser()
    except RuntimeError:
        raise WeightsError(f"{path}: there is no such home folder; write the path in full.") from None


def is_out_of_memory(error: BaseException | None) -> bool:
    """Whether memory ran out in the chain of `error`; torch only reports it in a RuntimeError's message.

    Messages of other exceptions are ignored: they may quote the file.
    """
    while error is not None:
        is_told_by_torch = isinstance(error, RuntimeError) and "can't allocate memory" in str(error)
        if isinstance(error, MemoryError) or is_told_by_torch:
            return True
        error = error.__context__
    return False


def _check_path(path: Path) -> None:
    if "\0" in str(path):
        raise WeightsError("a path cannot contain a NUL character: correct it")
    if advice := _url_advice(path):
        raise WeightsError(advice)


def _reader(path: Path) -> Callable[[bytes], Model | Export]:
    _check_path(path)
    if os.path.isdir(path):  # noqa: PTH112 - Path.is_dir raises if a parent folder cannot be read
        raise WeightsError(f"{_IRREGULAR}: name the file itself")
    suffix = path.suffix.lower()
    if suffix in _EXPORTS:
        raise WeightsError(
            f"a file that ends in {suffix} is {_EXPORTS[suffix]}: use the .pt that it was exported from, or "
            "an .onnx exported from that"
        )
    reader = _READERS.get(suffix)
    if reader is None:
        raise WeightsError(f"expected a file that ends in {', '.join(_READERS)}, found {shown(path.suffix)}")
    return reader


def read_once(path: Path) -> bytes:
    """All bytes of a regular file, read once: the bytes checked are the bytes used. Raises WeightsError."""
    _check_path(path)
    try:
        with open(path, "rb", opener=_open_without_waiting) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise WeightsError(_IRREGULAR)
            if status.st_size > MAX_FILE_BYTES:
                raise WeightsError(f"the file has {status.st_size} bytes; at most {MAX_FILE_BYTES} are read")
            data = file.read(status.st_size + 1)
            has_changed = os.fstat(file.fileno()).st_mtime_ns != status.st_mtime_ns
    except FileNotFoundError:
        raise WeightsError(f"there is no such file: {_spelling_advice(str(path))}") from None
    except OSError as error:
        raise UncheckedError(f"the file cannot be read ({error.strerror})") from None
    if has_changed or len(data) != status.st_size:
        raise UncheckedError("the file changed while it was read: try again when it is complete")
    return data


def _spelling_advice(path: str) -> str:
    if "$" in path:
        return "variables as in $HOME are not replaced here: write ~ or the path in full"
    if path != " ".join(path.split()):
        return "the path has blanks at its beginning or end, or several in a row: remove them"
    return "check the path for a missing '/' or a typo"


def _checked_digest(data: bytes, sha256: str) -> str:
    digest = hashlib.sha256(data).hexdigest()
    if digest != sha256.lower():
        raise WeightsError(
            f"its sha256 is {digest}, expected {sha256.lower()}: this is another file; "
            "get the right one, or correct the digest"
        )
    return digest


def _open_without_waiting(path: str, flags: int) -> int:
    """Open without blocking on a pipe that has no writer."""
    return os.open(path, flags | os.O_NONBLOCK)
