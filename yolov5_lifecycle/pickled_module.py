"""The module tree in a checkpoint, read with inert stand-ins: nothing in the file is run."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

from yolov5_lifecycle.model import WeightsError

MIN_TORCH = (2, 10)
"""weights_only=True itself could be broken before: CVE-2025-32434 (< 2.6), CVE-2026-24747 (< 2.10)."""
_MAX_DEPTH = 64
_STAND_IN_PREFIXES = ("models.", "utils.", "torch.nn.modules.")
# What training checkpoints hold beside the model (optimizer, date, paths); read as stand-ins and never looked
# at.
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
        "datetime.datetime",
        "argparse.Namespace",
    }
)
# safe_globals edits a table of the whole process.
_TABLE = threading.Lock()


class StandIn:
    """An object of a class that the file names: it keeps what it is given and does nothing."""

    pickled_name = ""

    def __new__(cls, *arguments: object) -> StandIn:
        stand_in = object.__new__(cls)
        stand_in.state = {}
        return stand_in

    def __init__(self, *arguments: object) -> None:
        self.state: Any

    def __setstate__(self, state: object) -> None:
        self.state = state

    def get(self, key: str) -> Any:
        """The attribute `key` of the pickled object, None when it has none."""
        return self.state.get(key) if isinstance(self.state, dict) else None

    def group(self, key: str) -> dict[Any, Any]:
        """The attribute `key`, which must be a dict or absent."""
        found = self.get(key)
        if not isinstance(found, dict | None):
            raise WeightsError(f"the module's {key} is a {type(found).__name__}, not a dict")
        return found or {}

    @property
    def children(self) -> list[StandIn]:
        """Submodules in order."""
        return [child for child in self.group("_modules").values() if isinstance(child, StandIn)]


def load_pickled(data: bytes, *, device: str) -> object:
    """What the checkpoint's pickle describes, with stand-ins for all classes and tensors on `device`.

    On the device "meta" no tensor takes memory. Raises WeightsError.
    """
    if tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2]) < MIN_TORCH:
        raise WeightsError(
            f"reading a .pt safely needs torch 2.10 or newer, found {torch.__version__}: "
            "convert the file to .safetensors on another machine (command `convert`)"
        )
    try:
        names = sorted(get_unsafe_globals_in_checkpoint(io.BytesIO(data)))
    except Exception as error:  # noqa: BLE001 - whatever a hostile pickle provokes is a refusal
        raise WeightsError(f"the pickle cannot be read: {_brief(error)}") from None
    _refuse_foreign(names)
    table = [(type("Named", (StandIn,), {"pickled_name": name}), name) for name in names]
    try:
        with _TABLE, safe_globals(table):  # type: ignore[arg-type]
            # Never weights_only=False, not even as a second try: the file decides what fails.
            return torch.load(io.BytesIO(data), map_location=device, weights_only=True)
    except Exception as error:  # noqa: BLE001
        raise WeightsError(f"the pickle cannot be read: {_brief(error)}") from None


def _refuse_foreign(names: list[str]) -> None:
    if any(name.startswith("ultralytics.") for name in names):
        raise WeightsError(
            "this model belongs to the ultralytics package (YOLOv8 or later, or a YOLOv5 'u' model); "
            "expected a checkpoint trained by YOLOv5 itself (v6 or v7)"
        )
    foreign = [
        name for name in names if not name.startswith(_STAND_IN_PREFIXES) and name not in _STAND_IN_NAMES
    ]
    if foreign:
        shown = ", ".join(name[:60] for name in foreign[:5])
        raise WeightsError(f"it names {shown}, which no YOLOv5 checkpoint needs: do not trust this file")


def tensors_of(
    module: StandIn, prefix: str = "", ancestors: tuple[int, ...] = ()
) -> Iterator[tuple[str, Tensor]]:
    """Keys and tensors of a module tree, as its state_dict would give them."""
    if id(module) in ancestors or len(ancestors) > _MAX_DEPTH:
        raise WeightsError("the module tree contains itself or is too deep")
    transient = module.get("_non_persistent_buffers_set") or ()
    for name, tensor in (module.group("_parameters") | module.group("_buffers")).items():
        if tensor is None or (isinstance(transient, (set, list, tuple)) and name in transient):
            continue
        if not isinstance(tensor, Tensor):
            raise WeightsError(f"{prefix}{str(name)[:80]} is a {type(tensor).__name__}, not a tensor")
        yield f"{prefix}{name}", tensor
    for name, child in module.group("_modules").items():
        if isinstance(child, StandIn):
            yield from tensors_of(child, f"{prefix}{name}.", (*ancestors, id(module)))


def _brief(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).splitlines()[0][:200] if str(error) else ''}"
