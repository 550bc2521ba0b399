"""The module tree in a checkpoint, read with inert stand-ins: nothing in the file is run."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.serialization import safe_globals

from yolov5_lifecycle.checkpoint_archive import Archive
from yolov5_lifecycle.model import UncheckedError, WeightsError, first_line, shown

MIN_TORCH = (2, 10)
"""weights_only=True itself could be broken before: CVE-2025-32434 (< 2.6), CVE-2026-24747 (< 2.10)."""
MAX_MODULES = 10_000
MAX_PATH_LENGTH = 200

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

    @property
    def kind(self) -> str:
        """The name of the class, without its package."""
        return self.pickled_name.rpartition(".")[2]

    def get(self, key: str) -> Any:
        """The attribute `key` of the pickled object, None when it has none."""
        return self.state.get(key) if isinstance(self.state, dict) else None

    def group(self, key: str) -> dict[Any, Any]:
        """The attribute `key`, which must be a dict or absent."""
        found = self.get(key)
        if not isinstance(found, dict | None):
            raise WeightsError(f"expected a dict as {key} of a {self.kind}, found {shown(found)}")
        return found or {}


def load_pickled(
    archive: Archive, names: Iterable[str], *, device: str, torch_version: str = torch.__version__
) -> object:
    """What the checkpoint's pickle describes, with stand-ins for the classes `names` and tensors on `device`.

    On the device "meta" no tensor takes memory. Raises WeightsError.
    """
    if tuple(int(part) for part in torch_version.split(".")[:2]) < MIN_TORCH:
        raise UncheckedError(
            f"reading a .pt safely needs torch 2.10 or newer, found {torch_version}: "
            "convert the file to .safetensors on a machine that has it (command `convert`)"
        )
    table = [(type(name, (StandIn,), {"pickled_name": name}), name) for name in names]
    try:
        with _TABLE, safe_globals(table):  # type: ignore[arg-type]
            # Never weights_only=False, not even as a second try: the file decides what fails.
            return torch.load(io.BytesIO(archive.data), map_location=device, weights_only=True)
    except Exception as error:  # noqa: BLE001 - whatever a hostile pickle provokes is a refusal
        raise WeightsError(f"the pickle cannot be read ({first_line(error)}): copy it again") from None


def modules_of(root: StandIn) -> dict[str, StandIn]:
    """Every module of the tree by its dotted path, as `named_modules` would give them; the root is ''."""
    found = {"": root}
    waiting = [("", root)]
    while waiting:
        path, module = waiting.pop()
        for name, child in module.group("_modules").items():
            if not isinstance(name, str) or not isinstance(child, StandIn):
                raise WeightsError(f"expected modules below {shown(path)}, found {shown(child)}")
            below = f"{path}.{name}" if path else name
            if len(found) >= MAX_MODULES or len(below) > MAX_PATH_LENGTH:
                raise WeightsError(f"it has more than {MAX_MODULES} modules, or one that contains itself")
            found[below] = child
            waiting.append((below, child))
    return found


def tensors_of(modules: Mapping[str, StandIn]) -> Iterator[tuple[str, Tensor]]:
    """Keys and tensors of a module tree, as its state_dict would give them."""
    for path, module in modules.items():
        transient = module.get("_non_persistent_buffers_set")
        for name, tensor in (module.group("_parameters") | module.group("_buffers")).items():
            if tensor is None or (isinstance(transient, (set, list, tuple)) and name in transient):
                continue
            if not isinstance(name, str) or not isinstance(tensor, Tensor):
                raise WeightsError(f"expected tensors in {shown(path)}, found {shown(tensor)}")
            yield f"{path}.{name}" if path else name, tensor
