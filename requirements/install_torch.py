"""Installs the build of torch that fits this machine: that of the CPU, unless there is a driver of NVIDIA's.

With the usual build of pip, nothing is installed here: the packages that are installed next bring it.
"""

import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

DRIVER_FILES = ("/proc/driver/nvidia/version", "/usr/lib/wsl/lib/libcuda.so.1")
"""What the driver of NVIDIA's leaves on Linux, and on Windows for Linux."""
PATIENCE = ("--timeout", "30", "--retries", "1")
"""Options of pip for an index that may be unreachable: a minute at most; by default pip tries for longer."""


def nvidia_driver(files: Sequence[str] = DRIVER_FILES) -> str:
    """The file that shows that this machine has a driver of NVIDIA's, else ""."""
    found = [file for file in files if Path(file).exists()]
    return found[0] if found else shutil.which("nvidia-smi") or ""


def install_cpu_build(index: str, pip_words: Sequence[str]) -> int:
    """pip's exit status; torch alone comes from `index`: the other packages there have other versions."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", *pip_words]
    return subprocess.call([*command, "--no-deps", "--index-url", index, "torch"])


def main(wanted: str, index: str, pip_words: Sequence[str], driver: str) -> int:
    """Exit status; `wanted` is "cpu", "cuda" or, for what fits, ""; so is `driver` where there is none."""
    if wanted == "cuda":
        return 0
    if wanted == "cpu":
        return install_cpu_build(index, pip_words)
    if driver:
        print(f"torch with CUDA, because there is an NVIDIA driver ({driver}). Without: TORCH=cpu")
        return 0
    print(
        "torch without CUDA, because no NVIDIA driver was found. With CUDA: TORCH=cuda",
        flush=True,
    )
    if install_cpu_build(index, [*PATIENCE, *pip_words]) != 0:
        print(f"{index} has not given torch, see above: pip's usual build follows, several GB larger.")
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # ends at once, without a traceback
    sys.exit(main(sys.argv[1], sys.argv[2], sys.argv[3:], nvidia_driver()))
