"""Fuzzes one target with atheris: `python -m fuzz.search TARGET [flags of libFuzzer]`.

Inputs with new coverage are saved to build/fuzz/TARGET/corpus, failing inputs to build/fuzz/TARGET/bad-*.
"""

from __future__ import annotations

import sys
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["yolov5_lifecycle"]):
    from fuzz.targets import TARGETS

_KEPT = Path(__file__).parent / "corpus"
_FOUND = Path("build") / "fuzz"


def main() -> None:
    """Run libFuzzer, which ends the process."""
    name, *flags = sys.argv[1:]
    target, found = TARGETS[name], _FOUND / name
    corpus = found / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for index, seed in enumerate(target.seeds()):
        (corpus / f"seed-{index}").write_bytes(seed)
    flags = [f"-artifact_prefix={found}/bad-", *flags, str(corpus), str(_KEPT / name)]
    atheris.Setup([name, *flags], target.check)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
