"""Progress of a command in the terminal."""

from __future__ import annotations

import sys


def show_progress(text: str, *, done: bool = False) -> None:
    """Overwrite the previous progress line with `text`; `done` ends it. No-op if stderr is no terminal."""
    if sys.stderr.isatty():
        end = "\n" if done else ""
        sys.stderr.write(f"\r{text}{end}")
        sys.stderr.flush()
