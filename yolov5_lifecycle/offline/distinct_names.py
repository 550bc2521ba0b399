"""Names of files about the images of one source, each for one image only."""

from __future__ import annotations


class DistinctNames:
    """Remembers which image has a name. Names that differ in upper and lower case only are the same."""

    def __init__(self) -> None:
        self._owners: dict[str, int] = {}

    def of(self, stem: str, number: int) -> str:
        """The name of the image `number`: `stem`, followed by the number if an earlier image has that name.

        `_frame_` sorts it behind the files of the first image of that name.
        """
        name = stem
        while self._owners.setdefault(name.casefold(), number) != number:
            name += f"_frame_{number:06}"
        return name
