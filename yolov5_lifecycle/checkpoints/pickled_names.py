"""The classes and functions named in a checkpoint's pickle."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from types import MappingProxyType

import torch

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
