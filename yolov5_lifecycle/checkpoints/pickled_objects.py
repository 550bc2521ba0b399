"""Names, modules and tensors as a checkpoint's pickle has them, before the data of any tensor is read."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from yolov5_lifecycle.models.model import WeightsError, shown

PARAMETER_MAKER = "torch._utils._rebuild_parameter"
TENSOR_MAKER = "torch._utils._rebuild_tensor_v2"
SETS = frozenset({"__builtin__.set", "builtins.set"})
ORDERED_DICT = "collections.OrderedDict"
ENCODE = "_codecs.encode"
GET_ATTRIBUTE = frozenset({"__builtin__.getattr", "builtins.getattr"})
"""Pickles methods. Segmentation models hold one of a class, fused models one of each Conv."""
NUMPY_SCALARS = frozenset({"numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar"})
"""Called with a type and the bytes of one number or text."""
STORAGES: Mapping[str, torch.dtype] = MappingProxyType(
    {
        "torch.FloatStorage": torch.float32,
        "torch.HalfStorage": torch.float16,
        "torch.BFloat16Storage": torch.bfloat16,
        "torch.DoubleStorage": torch.float64,
        "torch.LongStorage": torch.int64,
        "torch.IntStorage": torch.int32,
        "torch.ShortStorage": torch.int16,
        "torch.CharStorage": torch.int8,
        "torch.ByteStorage": torch.uint8,
        "torch.BoolStorage": torch.bool,
    }
)
# torch.load allows more names, but its bytearray and torch.FloatTensor allocate whatever the file claims.
TORCH_NAMES = (
    frozenset(STORAGES)
    | SETS
    | GET_ATTRIBUTE
    | NUMPY_SCALARS
    | {TENSOR_MAKER, PARAMETER_MAKER, ORDERED_DICT, ENCODE}
)
_STUB_PREFIXES = (
    *("models.", "utils.", "yolov5.models.", "yolov5.utils.", "torch.nn.modules."),
    *("torch.nn.parallel.", "torch.distributed."),  # around a model that was trained on several GPUs
    *("torch.nn.utils.prune.", "thop."),  # hooks of pruning, and of counting multiply-adds
)
_REMEDIES: Mapping[tuple[str, ...], str] = MappingProxyType(
    {
        ("torch._dynamo.", "torch._inductor.", "torch._TorchCompile", "contextlib.nullcontext"): (
            "it was saved after torch.compile and names {}, a part of the compiler, which is never run here: "
            "where the model was compiled, save `model._orig_mod` instead"
        ),
        (
            *("torch._utils._rebuild_device_tensor_from_", "torch._utils._rebuild_xla_tensor"),
            *("torch._utils._rebuild_hpu_tensor", "torch._utils._rebuild_ort_tensor"),
            "torch._utils._rebuild_mlc_tensor",
        ): (
            "it was saved while the model was on a device, such as an Apple GPU or DirectML, whose tensors "
            "torch saves as arrays: load it on the machine that wrote it, and save it again with "
            "`torch.save({{'model': model.cpu()}}, 'cpu.pt')`"
        ),
        ("torch.nn.utils.weight_norm.", "torch.nn.utils.spectral_norm."): (
            "it names {}, which computes weights from others: call torch.nn.utils.remove_weight_norm or "
            "remove_spectral_norm for each such layer, and save the model again"
        ),
    }
)
"""What else may be named by the model of an honest user, by the beginnings of the names, and what to do."""
# Contents of training checkpoints besides the model (optimizer, date, paths); never used.
_STUB_NAMES = frozenset(
    {
        "numpy.core.multiarray._reconstruct",
        "numpy._core.multiarray._reconstruct",
        "numpy.core.numeric._frombuffer",  # an array in protocol 5
        "numpy._core.numeric._frombuffer",
        "numpy.ndarray",
        "numpy.dtype",
        "pathlib.PosixPath",
        "pathlib.WindowsPath",
        "pathlib.PurePosixPath",
        "pathlib._local.PosixPath",
        "pathlib._local.WindowsPath",
        "datetime.datetime",
        "datetime.date",  # a class name such as 2024-01-02 in a data.yaml
        "argparse.Namespace",
        "torch.device",
        *map(str, STORAGES.values()),
    }
)

MAX_MODULES = 10_000
MAX_PATH_LENGTH = 200
MAX_DIMENSIONS = 16
_MAX_SIZE = 1 << 62
_COUNTS = ("total_ops", "total_params")
"""Buffers that thop adds to every module to count its multiply-adds and parameters."""


@dataclass(eq=False)
class Stub:
    """Stands for an instance of the class `pickled_name`: stores its state and does nothing."""

    pickled_name: str
    arguments: tuple[object, ...] = ()
    state: Any = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """The class name without its package."""
        return self.pickled_name.rpartition(".")[2]

    def get(self, key: str) -> Any:
        """The attribute `key` of the pickled object, or None."""
        return self.state.get(key) if isinstance(self.state, dict) else None

    def group(self, key: str) -> dict[Any, Any]:
        """The attribute `key`, which must be a dict or absent."""
        found = self.get(key)
        if not isinstance(found, dict | None):
            raise WeightsError(f"expected a dict as {key} of a {self.kind}, found {shown(found)}")
        return found or {}


@dataclass(frozen=True)
class Storage:
    """`elements` values of `dtype` in the record `key`."""

    key: str
    dtype: torch.dtype
    elements: int

    def __post_init__(self) -> None:
        _check_numbers(self.elements)

    @property
    def size_bytes(self) -> int:
        return self.elements * self.dtype.itemsize


@dataclass(frozen=True)
class StoredTensor:
    """A view of `storage` with this offset, shape and strides.

    Raises WeightsError if it exceeds the storage.
    """

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def __post_init__(self) -> None:
        _check_numbers(self.offset, *self.shape, *self.strides)
        if len(self.shape) != len(self.strides) or len(self.shape) > MAX_DIMENSIONS:
            raise WeightsError(f"the pickle cannot be read: a tensor has the strides {shown(self.strides)}")
        if math.prod(max(size, 1) for size in self.shape) >= _MAX_SIZE:
            raise WeightsError(f"the pickle cannot be read: a tensor has the shape {shown(self.shape)}")
        steps = zip(self.shape, self.strides, strict=True)
        last = self.offset + sum((size - 1) * stride for size, stride in steps)
        if 0 not in self.shape and last >= self.storage.elements:
            raise WeightsError(
                f"the tensors claim more than the file has: number {last} of {self.storage.elements}"
            )

    @property
    def dtype(self) -> torch.dtype:
        return self.storage.dtype

    @property
    def size_bytes(self) -> int:
        """Size of the tensor in memory."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def repeats_numbers(self) -> bool:
        """Whether elements may overlap in the storage."""
        return any(stride == 0 for stride, size in zip(self.strides, self.shape, strict=True) if size > 1)

    def on_meta(self) -> Tensor:
        """A meta tensor of the same shape and dtype, without data."""
        return torch.empty(self.shape, dtype=self.dtype, device="meta")

    def of(self, content: bytearray) -> Tensor:
        """The tensor as a view of `content`, the writable bytes of the storage. Raises WeightsError."""
        if len(content) != self.storage.size_bytes:
            raise WeightsError(
                f"the storage {shown(self.storage.key)} has {len(content)} bytes, "
                f"its tensors claim {self.storage.size_bytes}: copy the file again"
            )
        numbers = torch.frombuffer(content, dtype=self.dtype)
        return numbers.as_strided(self.shape, self.strides, self.offset)


def _check_numbers(*numbers: object) -> None:
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < _MAX_SIZE:
            raise WeightsError(f"the pickle cannot be read: a tensor has the size {shown(number)}")


def modules_of(root: Stub) -> dict[str, Stub]:
    """Every module of the tree by its dotted path, like `named_modules`; the root is ''."""
    found = {"": root}
    waiting = [("", root)]
    while waiting:
        path, module = waiting.pop()
        for name, child in module.group("_modules").items():
            if child is None:  # such as the normalisation of fused convolutions in v3
                continue
            if not isinstance(name, str) or not isinstance(child, Stub):
                raise WeightsError(f"expected modules below {shown(path)}, found {shown(child)}")
            below = f"{path}.{name}" if path else name
            if len(found) >= MAX_MODULES or len(below) > MAX_PATH_LENGTH:
                raise WeightsError(f"it has more than {MAX_MODULES} modules, or one that contains itself")
            found[below] = child
            waiting.append((below, child))
    return found


def tensors_of(modules: Mapping[str, Stub]) -> Iterator[tuple[str, StoredTensor]]:
    """Keys and tensors of a module tree, like its state_dict, without what thop counted."""
    for path, module in modules.items():
        transient = module.get("_non_persistent_buffers_set")
        for name, tensor in (module.group("_parameters") | module.group("_buffers")).items():
            if (
                tensor is None
                or name in _COUNTS
                or (isinstance(transient, (set, list, tuple)) and name in transient)
            ):
                continue
            if not isinstance(name, str) or not isinstance(tensor, StoredTensor):
                raise WeightsError(f"expected tensors in {shown(path)}, found {shown(tensor)}")
            yield f"{path}.{name}" if path else name, tensor


def check_names(names: Collection[str]) -> None:
    """Raise WeightsError if one of `names`, which a pickle has, belongs neither to YOLOv5 nor to torch."""
    if any(name.startswith("ultralytics.") for name in names):
        raise WeightsError(
            "this model belongs to the ultralytics package (YOLOv8 or later, or a YOLOv5 'u' model); "
            "expected a checkpoint trained by YOLOv5 itself (v6 or v7): train with that, or take an official "
            "one with `fetch_weights n`"
        )
    foreign = sorted(name for name in names if not _is_known(name))
    for beginnings, remedy in _REMEDIES.items():
        if foreign and all(name.startswith(beginnings) for name in foreign):
            raise WeightsError(remedy.format(shown(foreign[-1])))
    if foreign:
        more = f" and {len(foreign) - 3} more" if len(foreign) > 3 else ""
        named = ", ".join(shown(name) for name in foreign[:3])
        raise WeightsError(f"it names {named}{more}, which no YOLOv5 checkpoint needs: do not trust it")


def _is_known(name: str) -> bool:
    is_of_yolov5 = name.startswith(_STUB_PREFIXES) and re.fullmatch(r"[\w.]+", name) is not None
    return is_of_yolov5 or name in TORCH_NAMES or name in _STUB_NAMES
