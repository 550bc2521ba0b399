"""Models with weights from a formula, and what YOLOv5's own implementation computes with them.

They are the ten official sizes and those of `test/data/families.json`, one of every family.

Every tensor of the state dict is made of a = RandomState(crc32("golden:" + key)).normal(size=shape):

    running_var              0.5 + abs(a) / 2
    bn.weight                1 + a / 10
    weight of a convolution  1.2 a / sqrt(its inputs)
    others                   a / 10

Anchors and num_batches_tracked stay as the architecture has them. The pixels are
RandomState(11).rand(*shape), used as they are, without a division by 255.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from support.checkpoint_builder import official_model, saved, stripped
from support.colcon_workspace import REPOSITORY
from support.random_model import model_with
from yolov5_lifecycle.checkpoints.pickled_objects import Stub, tensors_of
from yolov5_lifecycle.checkpoints.yaml_architecture import architecture_of
from yolov5_lifecycle.models.architecture import SIZES, Architecture
from yolov5_lifecycle.models.model import Model

_DATA = REPOSITORY / "test" / "data"
_QUICK = ("n", "n6", "s")
EVERY_SIZE = [pytest.param(size, marks=() if size in _QUICK else pytest.mark.long, id=size) for size in SIZES]
_AMPLIFYING = ("x", "x6")
"""With these weights they amplify rounding errors: two correct implementations differ by 3e-4."""


@dataclasses.dataclass(frozen=True)
class ExpectedPredictions:
    """Expected raw predictions of a model: sums over all rows, and some of the rows, up to `tolerance`."""

    input_shape: tuple[int, ...]
    number_of_rows: int
    tolerance: float
    numbers: Mapping[str, Any]

    def check(self, raw: NDArray[np.float32]) -> None:
        """Fail unless `raw` (N, outputs) are these predictions up to rounding."""
        assert raw.dtype == np.float32
        rows, sums = np.array(self.numbers["rows"]), np.array(self.numbers["column_sums"])
        assert raw.shape == (self.number_of_rows, rows.shape[1])
        # Numbers near zero are compared with a thousandth of what is usual.
        rtol, atol = self.tolerance, self.tolerance * 1e-3
        np.testing.assert_allclose(raw[self.numbers["row_indices"]], rows, rtol=rtol, atol=atol)
        np.testing.assert_allclose(raw.sum(axis=0, dtype=np.float64), sums, rtol=rtol)


def expected_predictions(name: str) -> ExpectedPredictions:
    """Those of a size or a family."""
    if name in SIZES:
        found = numbers = _read("raw_predictions.json")["sizes"][name]
        tolerance = 1e-3 if name in _AMPLIFYING else 1e-5
    else:
        found = families()[name]
        tolerance, numbers = found["tolerance"], families()[found.get("same_numbers_as", name)]
    return ExpectedPredictions(tuple(found["input_shape"]), found["number_of_rows"], tolerance, numbers)


def formula_model(name: str) -> Model:
    """The model of a size or a family, with the weights of the formula."""
    return model_with(SIZES[name] if name in SIZES else family_architecture(name), _formula_tensor)


def formula_pixels(shape: tuple[int, ...]) -> Tensor:
    """Network input (1, 3, h, w) in [0, 1]."""
    return torch.from_numpy(np.random.RandomState(11).rand(*shape).astype(np.float32))


def _formula_tensor(key: str, blank: Tensor) -> Tensor:
    if not blank.is_floating_point():
        return torch.zeros(blank.shape, dtype=blank.dtype)
    return torch.from_numpy(_formula(key, tuple(blank.shape)).astype(np.float32))


def _formula(key: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    random = np.random.RandomState(zlib.crc32(f"golden:{key}".encode()))
    a = random.normal(size=shape)
    if key.endswith("running_var"):
        return np.asarray(np.abs(a) * 0.5 + 0.5)
    if key.endswith("bn.weight"):
        return 1 + 0.1 * a
    if len(shape) == 4:
        return a * 1.2 / math.sqrt(shape[1] * shape[2] * shape[3])
    return 0.1 * a


def _read(name: str) -> Any:
    return json.loads((_DATA / name).read_text())


@functools.cache
def families() -> Mapping[str, Any]:
    """The entries of the data by name: era and model, without an era for the newest code."""
    found: Mapping[str, Any] = _read("families.json")
    return found


EVERY_FAMILY = list(families())


def family_architecture(name: str) -> Architecture:
    """The architecture of an entry, with the activations that its modules have."""
    found = families()[name]
    anchors_px = tuple(tuple(map(tuple, level)) for level in found["anchors_px"])
    architecture = architecture_of(
        found["yaml"] | {"ch": found["image_channels"]},
        classes=found["yaml"]["nc"],
        anchors_px=anchors_px,
        strides=tuple(found["strides"]),
    )
    others = tuple((path, activation) for path, activation in found.get("other_activations", []))
    return dataclasses.replace(architecture, activation=found["activation"], other_activations=others)


def family_checkpoint(name: str) -> bytes:
    """The model of an entry as its version of YOLOv5 saves it, in float32."""
    formula = formula_model(name)
    before_v6 = name.startswith(("v3.", "v4.", "v5."))
    model = official_model(
        formula.architecture,
        formula.class_names,
        kind="models.yolo.Model" if before_v6 or name.startswith(("v6.0", "v6.1")) else "",
        half=False,
        network=formula.network(),
        before_v6=before_v6,
    )
    model.yaml = families()[name]["yaml"] | ({} if before_v6 else {"ch": formula.architecture.image_channels})
    return saved(stripped(model))


def state_dict_digest(modules: Mapping[str, Stub]) -> str:
    """SHA-256 of the names and shapes of all tensors in a file."""
    shapes = {key: list(tensor.shape) for key, tensor in tensors_of(modules)}
    return hashlib.sha256(json.dumps(shapes, sort_keys=True).encode()).hexdigest()


def modules_digest(modules: Mapping[str, Stub]) -> str:
    """SHA-256 of the paths of all modules in a file, with the names of their classes."""
    lines = sorted(f"{path} {module.kind}" for path, module in modules.items() if path not in ("", "model"))
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()
