"""Sanitizing of untrusted text for logs, terminals and diagnostics; which text is UTF-8."""

from __future__ import annotations

import re
from collections.abc import Callable

MAX_LINE = 1_000
"""Maximum characters of untrusted text shown in a line."""
MAX_TEXT = 10_000
"""Maximum characters of a message of several lines."""
_INDENT = "  "
_JOINERS = "\u200c\u200d"
"""Zero-width (non-)joiners. Persian words, scripts of India and emoji families are wrong without them."""
_LETTER = rf"[^\x00-\x7f{_JOINERS}]"
_STRAY_JOINER = re.compile(f"(?<!{_LETTER})[{_JOINERS}]|[{_JOINERS}](?!{_LETTER})")
"""One that has no such letter on each side: it joins nothing, but makes equal-looking texts differ."""


def in_one_line(text: str, limit: int = MAX_LINE) -> str:
    """`text` as one line of at most `limit` characters, with white space as blanks, unprintable ones as `?`.

    Escape sequences, control characters and bidirectional formatting characters are unprintable. Longer text
    is truncated and its length appended.
    """
    # Truncated before it is split: a string of many megabytes costs no more than its beginning.
    line = printable(" ".join(text[: 4 * limit].split()))
    return line if len(line) <= limit and len(text) <= 4 * limit else _cut(line, len(text), limit)


def in_lines(text: str, limit: int = MAX_TEXT) -> str:
    """`text` with its line breaks; later lines are indented by at least two blanks, unlike log lines.

    Handles unprintable characters and overlong text like `in_one_line`.
    """
    first, *later = (printable(line.replace("\t", "    ")) for line in text[: 2 * limit].split("\n"))
    if not all(line.startswith(_INDENT) for line in later):
        later = [_INDENT + line for line in later]
    lines = "\n".join([first, *later])
    return lines if len(lines) <= limit and len(text) <= 2 * limit else _cut(lines, len(text), limit)


def in_report(text: str) -> str:
    """The lines of `text`, which this program composed, without unprintable characters; of any length.

    The names in them must already be one line each: see `in_one_line`.
    """
    return "\n".join(map(printable, text.split("\n")))


def is_utf8(text: str) -> bool:
    """Whether `text` can be encoded as UTF-8: a path may have bytes that cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def printable(line: str) -> str:
    """`line` with `?` for everything that is not printable, line breaks included.

    A zero-width joiner or non-joiner between two letters that are not ASCII is kept: it changes their shapes
    only.
    """
    return _replaced(line, lambda _: "?")


def escaped(line: str) -> str:
    """Like `printable`, but with an escape such as `\\x1b` or `\\u202e`, which tells what was there."""
    return _replaced(line, lambda c: c.encode("unicode_escape").decode())


def _replaced(line: str, replacement: Callable[[str], str]) -> str:
    if line.isprintable():
        return line
    kept = "".join(c if c.isprintable() or c in _JOINERS else replacement(c) for c in line)
    return _STRAY_JOINER.sub(lambda found: replacement(found[0]), kept)


def _cut(text: str, length: int, limit: int) -> str:
    end = f"... ({length} characters)"
    return text[: max(0, limit - len(end))] + end
