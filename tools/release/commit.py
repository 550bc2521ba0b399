"""The last commit: its files and its time."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]


class Commit:
    """The last commit of the repository `repository`; changes that are not committed are no part of it."""

    def __init__(self, repository: Path = REPOSITORY) -> None:
        self._repository = repository

    def files(self) -> set[str]:
        """The paths of its files, relative to the repository."""
        return set(self._git("ls-tree", "-r", "-z", "--name-only", "HEAD").decode().split("\0")) - {""}

    def time(self) -> int:
        """When it was made, in seconds since 1970."""
        return int(self._git("log", "-1", "--format=%ct"))

    def uncommitted(self) -> list[str]:
        """The changed, added and deleted files that are no part of it, as `git status` marks them."""
        return self._git("status", "--porcelain").decode().splitlines()

    def export(self, folder: Path) -> Path:
        """Write its files into the new folder `folder`, with permissions 755 or 644; returns the folder."""
        folder.mkdir(parents=True)
        archive = self._git("-c", "tar.umask=022", "archive", "HEAD")
        subprocess.run(["tar", "-x", "-p", "-C", folder], input=archive, check=True)
        return folder

    def _git(self, *words: str) -> bytes:
        command = ["git", "-C", os.fspath(self._repository), *words]
        return subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout
