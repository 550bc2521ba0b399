"""The mutants that survive for a known reason: one line each in survivors.txt, `NAME -- REASON`."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

LIST = Path(__file__).with_name("survivors.txt")
_BETWEEN = " -- "


def known_survivors(text: str) -> dict[str, str]:
    """Name of each mutant -> why no test can notice it. Raises ValueError for a line without a reason."""
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    known = {
        name.strip(): reason.strip() for name, _, reason in (line.rpartition(_BETWEEN) for line in lines)
    }
    if "" in known or "" in known.values() or len(known) < len(lines):
        raise ValueError(f"each line of {LIST.name} must be a mutant once, '{_BETWEEN}' and the reason.")
    return known


def differences(
    known: Collection[str], *, existing: Iterable[str], tried: Collection[str], survived: Collection[str]
) -> Mapping[str, str]:
    """What is wrong, by name: survivors that are not listed, listed ones that are killed or exist no more."""
    existing = set(existing)
    return {
        **{
            name: "survives: kill it with a test, or list it with the reason"
            for name in survived
            if name not in known
        },
        **{
            name: "is listed, but killed: remove it"
            for name in known
            if name in tried and name not in survived
        },
        **{
            name: "is listed, but no such mutant is left: remove it" for name in known if name not in existing
        },
    }
