"""Hostile weights files."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from support.hostile_files import MAX_GROWN_MB, TOLD, read_all

from soak.finding import Finding


def refused_checkpoints() -> Finding:
    """Read every hostile and invalid weights file of the tests."""
    with TemporaryDirectory() as folder:
        answers = read_all(Path(folder)).values()
    accepted = [answer.name for answer in answers if not answer.is_refused]
    acted = [answer.name for answer in answers if answer.events]
    grown_mb = max(answer.grown_mb for answer in answers)
    return Finding(
        claim="every hostile or wrong weights file is refused",
        done=f"{len(answers)} kinds of files",
        result=f"{len(accepted)} accepted, {len(acted)} ran anything; at most {grown_mb:.0f} MB for one",
        limit=f"{len(TOLD)} kinds; 0, 0; {MAX_GROWN_MB} MB",
        is_met=len(answers) == len(TOLD) and not accepted and not acted and grown_mb < MAX_GROWN_MB,
    )
