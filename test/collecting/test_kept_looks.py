"""The distance of an image to those that are kept, compared with a slow reference."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from support.candidates import look_of

from yolov5_lifecycle.collecting.kept_looks import MIN_ROWS, KeptLooks
from yolov5_lifecycle.collecting.shades import SHADES, Shades


def unit(seed: int) -> NDArray[np.float32]:
    return look_of(seed) / np.float32(np.linalg.norm(look_of(seed)))


def shades(seed: int) -> Shades:
    return np.random.default_rng(seed).integers(-64, 64, SHADES).astype(np.int8)


@pytest.mark.long
def test_the_distance_is_that_of_the_nearest_after_many_were_added_and_removed() -> None:
    kept, present = KeptLooks(), {}
    rng = np.random.default_rng(0)
    for seed in range(3 * MIN_ROWS):
        kept.add(f"{seed}", unit(seed), shades(seed))
        present[f"{seed}"] = unit(seed)
        if rng.random() < 0.5:
            gone = str(rng.choice([*present]))
            kept.remove(gone)
            del present[gone]
    for seed in range(10_000, 10_020):
        nearest = max(float(row @ unit(seed)) for row in present.values())
        assert kept.distance(look_of(seed)) == pytest.approx(1 - nearest, abs=1e-5)
    assert kept.distance(next(iter(present.values())) * 5) == pytest.approx(0, abs=1e-5)
    for image, embedding in present.items():
        assert kept.has_same_shades(embedding, shades(int(image)), distance=0.1)
        assert not kept.has_same_shades(embedding, shades(int(image) + 1), distance=0.1)


def test_without_any_and_of_another_model_an_image_is_infinitely_far() -> None:
    kept = KeptLooks()
    assert kept.distance(look_of(0)) == math.inf
    kept.add("other", np.ones(3, np.float32), shades(0))
    kept.add("empty", np.empty(0, np.float32), shades(0))
    assert kept.distance(look_of(0)) == math.inf
    assert kept.distance(np.zeros(3, np.float32)) == math.inf
    kept.remove("other")
    kept.remove("never added")
    assert kept.distance(np.ones(3, np.float32)) == math.inf
