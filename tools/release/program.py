"""Runs a program whose output matters only when it fails."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path


def run_quietly(words: Sequence[str | Path], variables: Mapping[str, str] | None = None) -> None:
    """Run the program `words` with `variables` added to the environment.

    Its output goes to stderr if it fails, else nowhere. Raises CalledProcessError.
    """
    environment = os.environ | dict(variables or {})
    try:
        subprocess.run(words, env=environment, check=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    except subprocess.CalledProcessError as error:
        sys.stderr.write(error.stdout.decode(errors="replace"))
        raise
