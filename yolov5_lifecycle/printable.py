"""Sanitizing of untrusted text for logs, terminals and diagnostics; which text is UTF-8."""

from __future__ import annotations

MAX_LINE = 1_000
"""Maximum characters of untrusted text shown in a line."""
MAX_TEXT = 10_000
"""Maximum characters of a message of several lines."""
_INDENT = "  "


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
    """`line` with `?` for everything that is not printable, line breaks included."""
    return line if line.isprintable() else "".join(c if c.isprintable() else "?" for c in line)


def _cut(text: str, length: int, limit: int) -> str:
    end = f"... ({length} characters)"
    return text[: max(0, limit - len(end))] + end
