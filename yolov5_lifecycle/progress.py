"""How far a command is, for who watches it in a terminal."""

from __future__ import annotations

import sys


def show_progress(text: str, *, done: bool = False) -> None:
    """Write `text` over the one before it; `done` ends the line. Nothing where stderr is no terminal."""
    if sys.stderr.isatty():
        end = "\n" if done else ""
        sys.stderr.write(f"\r{text}{end}")
        sys.stderr.flush()
