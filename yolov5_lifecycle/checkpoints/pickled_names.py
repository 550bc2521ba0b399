"""The classes and functions named in a checkpoint's pickle."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from types import MappingProxyType

import torch

from yolov5_lifecycle.models.model import WeightsError, shown

TENSOR_MAKERS = frozenset({"torch._utils._rebuild_parameter", "torch._utils._rebuild_tensor_v2"})
SETS = frozenset({"__builtin__.set", "builtins.set"})
ORDERED_DICT = "collections.OrderedDict"
ENCODE = "_codecs.encode"
GET_ATTRIBUTE = frozenset({"__builtin__.getattr", "builtins.getattr"})
"""Pickles methods. Segmentation models hold one of a class, fused models one of each Conv."""
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
TORCH_NAMES = TENSOR_MAKERS | frozenset(STORAGES) | SETS | GET_ATTRIBUTE | {ORDERED_DICT, ENCODE}
_STUB_PREFIXES = (
    *("models.", "utils.", "yolov5.models.", "yolov5.utils.", "torch.nn.modules."),
    *("torch.nn.parallel.", "torch.distributed."),  # around a model that was trained on several GPUs
)
_OF_COMPILER = ("torch._dynamo.", "torch._inductor.", "torch._TorchCompile", "contextlib.nullcontext")
# Contents of training checkpoints besides the model (optimizer, date, paths); never used.
_STUB_NAMES = frozenset(
    {
        "numpy.core.multiarray._reconstruct",
        "numpy.core.multiarray.scalar",
        "numpy._core.multiarray._reconstruct",
        "numpy._core.multiarray.scalar",
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
    }
)


def stubs_among(names: Collection[str]) -> list[str]:
    """Those of `names`, which a pickle has, that torch does not define.

    Raises WeightsError if one of them does not belong to YOLOv5.
    """
    if any(name.startswith("ultralytics.") for name in names):
        raise WeightsError(
            "this model belongs to the ultralytics package (YOLOv8 or later, or a YOLOv5 'u' model); "
            "expected a checkpoint trained by YOLOv5 itself (v6 or v7): train with that, or take an official "
            "one with `fetch_weights n`"
        )
    foreign = sorted(name for name in names if not _is_known(name))
    if foreign and all(name.startswith(_OF_COMPILER) for name in foreign):
        raise WeightsError(
            f"it was saved after torch.compile and names {shown(foreign[-1])}, a part of the compiler, "
            "which is never run here: where the model was compiled, save `model._orig_mod` instead"
        )
    if foreign:
        more = f" and {len(foreign) - 3} more" if len(foreign) > 3 else ""
        named = ", ".join(shown(name) for name in foreign[:3])
        raise WeightsError(f"it names {named}{more}, which no YOLOv5 checkpoint needs: do not trust it")
    return sorted(name for name in names if name not in TORCH_NAMES)


def _is_known(name: str) -> bool:
    is_of_yolov5 = name.startswith(_STUB_PREFIXES) and re.fullmatch(r"[\w.]+", name) is not None
    return is_of_yolov5 or name in TORCH_NAMES or name in _STUB_NAMES
