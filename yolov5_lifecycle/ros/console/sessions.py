"""The token, the file that stores it, the sessions of browsers that have sent it, and how often they may."""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from tempfile import NamedTemporaryFile

from starlette.exceptions import HTTPException

from yolov5_lifecycle.input_file import read_regular_file

SESSION_S = 12 * 3600.0
_MAX_SESSIONS = 200
_SECRET_BYTES = 32
MIN_TOKEN_LENGTH = 32
_MAX_FILE_BYTES = 4096
_TRIES_PER_S = 5 / 60
_TRIES = 5
MAX_ADDRESSES = 1_000
"""Those used recently, each of which has a budget."""


class Budget:
    """At most `burst` at once and `rate_hz` in the long run."""

    def __init__(self, rate_hz: float, burst: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate_hz = rate_hz
        self._burst = burst
        self._clock = clock
        self._left = burst
        self._since_s = clock()

    def spend(self) -> bool:
        """Whether it may happen now; if so, it counts."""
        now_s = self._clock()
        self._left = min(self._burst, self._left + (now_s - self._since_s) * self._rate_hz)
        self._since_s = now_s
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Sessions:
    """Sessions of clients that sent `token`; only hashes are kept. `clock` returns monotonic seconds."""

    def __init__(self, token: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._token_hash = _hash(token)
        self._clock = clock
        self._ends_s: OrderedDict[bytes, float] = OrderedDict()
        self._failures_of = lru_cache(MAX_ADDRESSES)(lambda _: Budget(_TRIES_PER_S, _TRIES, clock=clock))

    def knows_token(self, given: str, address: str) -> bool:
        """Whether `given` is the token; raises HTTPException after too many wrong ones from `address`.

        The right token counts always: behind a proxy, strangers have the same address as the owner.
        """
        if hmac.compare_digest(_hash(given), self._token_hash):
            return True
        if not self._failures_of(address).spend():
            raise HTTPException(429, "too many wrong tokens: wait a minute", {"Retry-After": "60"})
        return False

    def begin(self) -> str:
        """Begin a session; returns its id, which is random and not derived from the token."""
        session_id = secrets.token_urlsafe(_SECRET_BYTES)
        self._ends_s[_hash(session_id)] = self._clock() + SESSION_S
        if len(self._ends_s) > _MAX_SESSIONS:
            self._ends_s.popitem(last=False)
        return session_id

    def left_s(self, session_id: str) -> float:
        """Seconds until this session expires; 0 if it has or does not exist."""
        # The dictionary compares hashes, so timing reveals nothing about ids.
        end_s = self._ends_s.get(_hash(session_id))
        return max(end_s - self._clock(), 0.0) if end_s is not None else 0.0


def _hash(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()


def usual_path(environment: Mapping[str, str]) -> Path:
    """`yolov5_console/token` in $XDG_STATE_HOME, or in ~/.ros without that variable.

    Raises OSError for a user without a home folder.
    """
    state = Path(environment.get("XDG_STATE_HOME", ""))
    try:
        return (state if state.is_absolute() else Path.home() / ".ros") / "yolov5_console" / "token"
    except RuntimeError:
        raise OSError(
            "the token cannot be stored: this user has no home folder. Set HOME, or choose a file with "
            "--token-file."
        ) from None


def kept_token(path: Path) -> tuple[str, bool]:
    """The token in the file at `path`, created with a new token if missing; and whether it is new.

    Raises OSError, whose message has the cause and a remedy, if it cannot be stored, if others may read the
    file, or if it has no token of at least MIN_TOKEN_LENGTH.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        is_new = not path.exists() and _is_made(path)
        token = read_regular_file(path, _MAX_FILE_BYTES).decode("ascii", "replace").strip()
        status = path.stat()
    except ValueError:
        raise OSError(
            f"{path} is not a regular file: remove it, or choose another with --token-file."
        ) from None
    except OSError as error:
        raise OSError(
            f"the token cannot be stored in {path}: {error.strerror}. Choose another file with --token-file."
        ) from error
    if status.st_uid != os.geteuid() or status.st_mode & 0o077:
        raise OSError(f"others may have read the token in {path}: remove the file to get a new token.")
    if len(token) < MIN_TOKEN_LENGTH or not token.isprintable() or " " in token:
        raise OSError(
            f"{path}: expected one token of at least {MIN_TOKEN_LENGTH} letters and digits, found "
            f"{len(token)} characters: remove the file to get a new token."
        )
    return token, is_new


def _is_made(path: Path) -> bool:
    """Store a new token, in a file that is whole from the first moment; False if another console did."""
    with NamedTemporaryFile("w", dir=path.parent, prefix=".", suffix=".part") as file:
        file.write(secrets.token_urlsafe(_SECRET_BYTES) + "\n")
        file.flush()
        with suppress(FileExistsError):
            os.link(file.name, path)
            return True
    return False
