"""Text for logs, terminals, diagnostics: without secrets and unprintable characters; which text is UTF-8."""

from __future__ import annotations

import re
import shlex
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

_SCHEME = r"[A-Za-z][A-Za-z0-9+.-]{0,31}://"
_ADDRESS = re.compile(
    rf"""(?<![A-Za-z0-9+.-])(?P<scheme>{_SCHEME})(?P<rest>(?:(?![\s'"=(,;<\[]{_SCHEME}).)*)""", re.DOTALL
)
"""An address, and what follows it up to the next one."""
_QUERY_VALUE = re.compile(r"(=)[^&]*|(?<=[?&])[^=&]+(?=&|$)")
_PROPERTY = re.compile(
    rf"""(?<=\s)([\w:-]+\s*=\s*)(?!["']?{_SCHEME}|\*\*\*)("(?:\\.|[^"\\])*"?|'(?:\\.|[^'\\])*'?|\S+)"""
)
"""Of an element in a GStreamer pipeline."""


def without_secrets(line: str) -> str:
    """`line` with `***` for all before the last @ of an address, for its values, and for those of a pipeline.

    Quotes around an address have nothing else in them, and a line that begins with one has it up to a colon
    and a blank. Elsewhere an address ends at a blank, unless an @ follows. What may be part of a password
    counts as such.
    """
    line = _ADDRESS.sub(_without_secrets, line)
    return _PROPERTY.sub(r"\1***", line) if " ! " in line else line


def _without_secrets(found: re.Match[str]) -> str:
    end = _address_end(found)
    address, after = found["rest"][:end], found["rest"][end:]
    before, at, host = address.rpartition("@")
    if ":" not in before:  # then an @ in the path ends no password
        authority = re.split("[/?#]", address, maxsplit=1)[0]
        at = "@" if "@" in authority else ""
        host = address[authority.rfind("@") + 1 :]
    values = _QUERY_VALUE.sub(lambda value: f"{value[1] or ''}***", host)
    return f"{found['scheme']}{'***' if at else ''}{at}{values}{after}"


def _address_end(found: re.Match[str]) -> int:
    """Where in the rest the address ends."""
    rest, quote = found["rest"], found.string[: found.start()][-1:]
    if not quote:
        end = rest.find(": ", rest.rfind("@") + 1)  # where a message about the address begins
        return end if end >= 0 else len(rest)
    if quote in "'\"":
        closing = re.search(rf"{quote}(?!\w)", rest)
        return closing.start() if closing else len(rest)
    end = _token_end(rest, 0)
    return _token_end(rest, max(end, rest.rfind("@"))) if ":" in rest[:end] else end


def _token_end(text: str, begin: int) -> int:
    blank = re.compile(r"\s|$").search(text, begin)
    return blank.start() if blank else len(text)


def in_one_line(text: str, limit: int = MAX_LINE) -> str:
    """`text` as one line of at most `limit` characters, with white space as blanks, unprintable ones as `?`.

    Secrets are replaced, see `without_secrets`.
    Escape sequences, control characters and bidirectional formatting characters are unprintable. Longer text
    is truncated and its length appended.
    """
    # Truncated before it is split: a string of many megabytes costs no more than its beginning.
    line = printable(without_secrets(" ".join(text[: 4 * limit].split())))
    return line if len(line) <= limit and len(text) <= 4 * limit else _cut(line, len(text), limit)


def shell_command(*words: object) -> str:
    """The command line to type for `words`: each is quoted if it has blanks or characters of the shell."""
    return shlex.join(map(str, words))


def in_lines(text: str, limit: int = MAX_TEXT) -> str:
    """`text` with its line breaks; later lines are indented by at least two blanks, unlike log lines.

    Handles secrets, unprintable characters and overlong text like `in_one_line`.
    """
    lines_of_text = text[: 2 * limit].replace("\t", "    ").split("\n")
    first, *later = (printable(without_secrets(line)) for line in lines_of_text)
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
