"""What is made for an input size is made once, the sizes used last are kept, and nothing after the close."""

from __future__ import annotations

import pytest
import torch

from yolov5_lifecycle.runtimes.networks_by_size import NetworksBySize, are_zero, denormals_as_zero
from yolov5_lifecycle.runtimes.runtime import InferenceError

SIZES = [(64, 32 * place) for place in range(1, 6)]


class Maker:
    """Makes a name of a size, and remembers what it has made."""

    def __init__(self) -> None:
        self.made: list[tuple[int, int]] = []

    def __call__(self, size_hw: tuple[int, int]) -> str:
        self.made.append(size_hw)
        return f"{size_hw[1]}x{size_hw[0]}"


def used(networks: NetworksBySize[str], size_hw: tuple[int, int]) -> str:
    with networks.running(size_hw) as name:
        return name


def test_a_size_is_made_once() -> None:
    maker = Maker()
    networks = NetworksBySize(maker)
    names = [used(networks, size_hw) for size_hw in ((64, 96), (96, 64), (64, 96))]
    assert names == ["96x64", "64x96", "96x64"]
    assert maker.made == [(64, 96), (96, 64)]


def test_of_five_sizes_the_one_that_was_used_longest_ago_is_evicted() -> None:
    maker = Maker()
    networks = NetworksBySize(maker)
    for size_hw in (*SIZES[:4], SIZES[0], SIZES[4]):
        used(networks, size_hw)
    for size_hw in (SIZES[0], SIZES[2], SIZES[3], SIZES[4]):
        used(networks, size_hw)
    assert maker.made == SIZES, "four are kept"
    used(networks, SIZES[1])
    assert maker.made == [*SIZES, SIZES[1]]


def test_after_the_close_a_frame_is_refused_and_the_one_in_progress_goes_on() -> None:
    networks = NetworksBySize(Maker())
    with networks.running((64, 96)) as name:
        networks.close()
        networks.close()
        assert name == "96x64"
    with pytest.raises(InferenceError, match="closed; load the model again"), networks.running((64, 96)):
        pass


def test_denormal_numbers_are_zero_while_a_network_is_made_and_runs_and_not_after() -> None:
    with NetworksBySize(lambda _: are_zero()).running((64, 64)) as was_zero:
        assert was_zero
        assert are_zero()
    assert not are_zero()


def test_a_thread_that_took_denormal_numbers_for_zero_does_so_afterwards() -> None:
    torch.set_flush_denormal(True)
    try:
        with denormals_as_zero():
            assert are_zero()
        assert are_zero()
    finally:
        torch.set_flush_denormal(False)
