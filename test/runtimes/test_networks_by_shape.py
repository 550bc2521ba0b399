"""A network is made once for each input shape; those used last are kept, none after the close."""

from __future__ import annotations

import pytest
import torch

from yolov5_lifecycle.runtimes.networks_by_shape import (
    NetworksByShape,
    Shape,
    are_zero,
    denormals_as_zero,
)
from yolov5_lifecycle.runtimes.runtime import InferenceError

SHAPES = [(64, 32 * place) for place in range(1, 6)]


class Maker:
    """Makes a name of a shape, and remembers what it has made."""

    def __init__(self) -> None:
        self.made: list[Shape] = []

    def __call__(self, shape: Shape) -> str:
        self.made.append(shape)
        return "x".join(map(str, shape))


def used(networks: NetworksByShape[str], shape: Shape) -> str:
    with networks.running(shape) as name:
        return name


def test_of_five_shapes_the_one_that_was_used_longest_ago_is_evicted() -> None:
    maker = Maker()
    networks = NetworksByShape(maker)
    for shape in (*SHAPES[:4], SHAPES[0], SHAPES[4]):
        used(networks, shape)
    for shape in (SHAPES[0], SHAPES[2], SHAPES[3], SHAPES[4]):
        used(networks, shape)
    assert maker.made == SHAPES, "four are kept"
    used(networks, SHAPES[1])
    assert maker.made == [*SHAPES, SHAPES[1]]


def test_a_camera_that_changes_its_size_with_every_frame_evicts_none_of_the_others_sizes() -> None:
    maker = Maker()
    networks = NetworksByShape(maker, kept=12)  # of six cameras
    for width in range(1, 40):
        for shape in (*SHAPES, (320, 32 * width)):
            used(networks, shape)
    assert len(maker.made) == len(set(maker.made))


def test_after_the_close_a_frame_is_refused_and_the_one_in_progress_goes_on() -> None:
    networks = NetworksByShape(Maker())
    with networks.running((64, 96)) as name:
        networks.close()
        networks.close()
        assert name == "64x96"
    with pytest.raises(InferenceError, match="closed; load the model again"), networks.running((64, 96)):
        pass


def test_denormal_numbers_are_zero_while_a_network_is_made_and_runs_and_not_after() -> None:
    with NetworksByShape(lambda _: are_zero()).running((64, 64)) as was_zero:
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
