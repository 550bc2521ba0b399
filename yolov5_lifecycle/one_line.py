"""Foreign text in messages of ours."""

from __future__ import annotations


def in_one_line(text: str) -> str:
    """`text` as a log can show it: each white space a blank, what cannot be printed a question mark.

    What a hostile file puts into an error of another library must not command a terminal.
    """
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))
