"""What is made for a size of frame is made once, and the sizes used last are kept."""

from __future__ import annotations

from yolov5_lifecycle.runtimes.size_cache import SizeCache

SIZES = [(64, 32 * place) for place in range(1, 6)]


class Maker:
    """Makes a name of a size, and remembers what it has made."""

    def __init__(self) -> None:
        self.made: list[tuple[int, int]] = []

    def __call__(self, size_hw: tuple[int, int]) -> str:
        self.made.append(size_hw)
        return f"{size_hw[1]}x{size_hw[0]}"


def test_a_size_is_made_once() -> None:
    maker = Maker()
    cache = SizeCache(maker)
    assert [cache[64, 96], cache[96, 64], cache[64, 96]] == ["96x64", "64x96", "96x64"]
    assert maker.made == [(64, 96), (96, 64)]


def test_of_five_sizes_the_one_that_was_used_longest_ago_is_let_go() -> None:
    maker = Maker()
    cache = SizeCache(maker)
    for size_hw in (*SIZES[:4], SIZES[0], SIZES[4]):
        cache[size_hw]
    for size_hw in (SIZES[0], SIZES[2], SIZES[3], SIZES[4]):
        cache[size_hw]
    assert maker.made == SIZES, "four are kept"
    cache[SIZES[1]]
    assert maker.made == [*SIZES, SIZES[1]]
