"""Sessions of browsers that have sent the token, and a limit on wrong tokens."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable

from yolov5_lifecycle.ros.console.budget import Budget, Budgets

SESSION_S = 12 * 3600.0
_MAX_SESSIONS = 200
_ID_BYTES = 32
_TRIES_PER_S = 5 / 60
_TRIES = 5


class TooManyTriesError(Exception):
    """The token was wrong too often; wait a minute."""


class Sessions:
    """Sessions of clients that sent `token`; only hashes are kept. `clock` returns monotonic seconds."""

    def __init__(self, token: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._token_hash = _hash(token)
        self._clock = clock
        self._ends_s: OrderedDict[bytes, float] = OrderedDict()
        self._failures_of = Budgets(lambda: Budget(_TRIES_PER_S, _TRIES, clock=clock))

    def knows_token(self, given: str, address: str) -> bool:
        """Whether `given` is the token; raises TooManyTriesError after too many wrong ones from `address`.

        The right token counts always: behind a proxy, strangers have the same address as the owner.
        """
        if hmac.compare_digest(_hash(given), self._token_hash):
            return True
        if not self._failures_of.of(address).spend():
            raise TooManyTriesError
        return False

    def begin(self) -> str:
        """Begin a session; returns its id, which is random and not derived from the token."""
        session_id = secrets.token_urlsafe(_ID_BYTES)
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
