"""The file that stores the console's token."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import NamedTemporaryFile

MIN_LENGTH = 32
_BYTES = 32
_MAX_BYTES = 4096
_FOLDER = "yolov5_console"


class TokenFileError(Exception):
    """The token cannot be stored or must not be used; the message has the cause and a remedy."""


def usual_path(environment: Mapping[str, str]) -> Path:
    """`yolov5_console/token` in $XDG_STATE_HOME, or in ~/.ros without that variable.

    Raises TokenFileError for a user without a home folder.
    """
    state = Path(environment.get("XDG_STATE_HOME", ""))
    try:
        return (state if state.is_absolute() else Path.home() / ".ros") / _FOLDER / "token"
    except RuntimeError:
        raise TokenFileError(
            "the token cannot be stored: this user has no home folder. Set HOME, or choose a file with "
            "--token-file."
        ) from None


def kept_token(path: Path) -> tuple[str, bool]:
    """The token in the file at `path`, created with a new token if missing; and whether it is new.

    Raises TokenFileError if others may read the file, or if it has no token of at least MIN_LENGTH.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            return _read(path), False
        try:
            return _made(path), True
        except FileExistsError:  # another console has just made it
            return _read(path), False
    except OSError as error:
        raise TokenFileError(
            f"the token cannot be stored in {path}: {error.strerror}. Choose another file with --token-file."
        ) from error


def _made(path: Path) -> str:
    """A new token in a new file, which has its content from the first moment; raises FileExistsError."""
    token = secrets.token_urlsafe(_BYTES)
    with NamedTemporaryFile("w", dir=path.parent, prefix=".", suffix=".part") as file:
        os.fchmod(file.fileno(), 0o600)  # regardless of the umask
        file.write(token + "\n")
        file.flush()
        os.fsync(file.fileno())
        os.link(file.name, path)
    return token


def _read(path: Path) -> str:
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise TokenFileError(
                f"{path} is not a regular file: remove it, or choose another with --token-file."
            )
        if status.st_uid != os.geteuid() or status.st_mode & 0o077:
            raise TokenFileError(
                f"others may have read the token in {path}: remove the file to get a new token."
            )
        token = file.read(_MAX_BYTES).decode("ascii", "replace").strip()
    if len(token) < MIN_LENGTH or not token.isprintable() or " " in token:
        raise TokenFileError(
            f"{path}: expected one token of at least {MIN_LENGTH} letters and digits, found {len(token)} "
            "characters: remove the file to get a new token."
        )
    return token
