"""The names in a checkpoint's pickle: the classes and functions that it mentions."""

from __future__ import annotations

import re

from yolov5_lifecycle.model import WeightsError, shown
from yolov5_lifecycle.pickle_operations import operations

TENSOR_MAKERS = frozenset({"torch._utils._rebuild_parameter", "torch._utils._rebuild_tensor_v2"})
SETS = frozenset({"__builtin__.set", "builtins.set"})
ORDERED_DICT = "collections.OrderedDict"
ENCODE = "_codecs.encode"
STORAGES = frozenset(
    f"torch.{kind}Storage"
    for kind in ("Float", "Half", "BFloat16", "Double", "Long", "Int", "Short", "Char", "Byte", "Bool")
)
# torch's own table is longer, but its bytearray and torch.FloatTensor allocate what the file tells them to.
_TORCH_NAMES = TENSOR_MAKERS | STORAGES | SETS | {ORDERED_DICT, ENCODE}
_STAND_IN_PREFIXES = ("models.", "utils.", "yolov5.models.", "yolov5.utils.", "torch.nn.modules.")
# What training checkpoints hold beside the model (optimizer, date, paths); never looked at.
_STAND_IN_NAMES = frozenset(
    {
        "numpy.core.multiarray._reconstruct",
        "numpy.core.multiarray.scalar",
        "numpy._core.multiarray._reconstruct",
        "numpy._core.multiarray.scalar",
        "numpy.ndarray",
        "numpy.dtype",
        "pathlib.PosixPath",
        "pathlib.WindowsPath",
        "pathlib.PurePosixPath",
        "pathlib._local.PosixPath",
        "pathlib._local.WindowsPath",
        "datetime.datetime",
        "argparse.Namespace",
    }
)


def stand_in_names(pickle: bytes) -> list[str]:
    """The names in `pickle` that torch does not know.

    Raises WeightsError if one of them is foreign to YOLOv5.
    """
    names = {operation.text for operation in operations(pickle) if operation.name == "GLOBAL"}
    _refuse_foreign(names)
    return sorted(names - _TORCH_NAMES)


def _refuse_foreign(names: set[str]) -> None:
    if any(name.startswith("ultralytics.") for name in names):
        raise WeightsError(
            "this model belongs to the ultralytics package (YOLOv8 or later, or a YOLOv5 'u' model); "
            "expected a checkpoint trained by YOLOv5 itself (v6 or v7): train with that, or take an official "
            "one with `fetch_weights n`"
        )
    known = _TORCH_NAMES | _STAND_IN_NAMES
    foreign = sorted(
        name
        for name in names - known
        if not (name.startswith(_STAND_IN_PREFIXES) and re.fullmatch(r"[\w.]+", name))
    )
    if foreign:
        more = f" and {len(foreign) - 3} more" if len(foreign) > 3 else ""
        named = ", ".join(shown(name) for name in foreign[:3])
        raise WeightsError(f"it names {named}{more}, which no YOLOv5 checkpoint needs: do not trust it")
