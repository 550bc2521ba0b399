"""Fuzzes one target with atheris: `python -m fuzz.search TARGET [flags of libFuzzer]`.

Inputs with new coverage are saved to build/fuzz/TARGET/corpus, failing inputs to build/fuzz/TARGET/bad-*.
"""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

import atheris

from benchmark.process_memory import resident_mb

with atheris.instrument_imports(include=["yolov5_lifecycle"]):
    from fuzz.targets import TARGETS

_KEPT = Path(__file__).parent / "corpus"
_FOUND = Path("build") / "fuzz"
_PATIENCE_S = 30
_MEMORY_MB = 4096
"""An input that takes longer, or more memory besides what the imports take, is handled wrongly."""


def main() -> None:
    """Run libFuzzer, which ends the process."""
    name, *flags = sys.argv[1:]
    target, found = TARGETS[name], _FOUND / name
    corpus = found / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for index, seed in enumerate(target.seeds()):
        (corpus / f"seed-{index}").write_bytes(seed)
    memory_mb = round(resident_mb(os.getpid())) + _MEMORY_MB
    limits = [f"-timeout={_PATIENCE_S}", f"-rss_limit_mb={memory_mb}"]
    flags = [f"-artifact_prefix={found}/bad-", *limits, *flags, str(corpus), str(_KEPT / name)]
    warnings.simplefilter("error")  # as in the tests
    atheris.Setup([name, *flags], target.check)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
