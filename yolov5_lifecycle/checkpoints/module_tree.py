"""The module tree of a checkpoint, unpickled into inert stubs: no code in the file is executed."""

from __future__ import annotations

import io
import pickle
import re
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from yolov5_lifecycle.checkpoints.archive import PICKLE, Archive
from yolov5_lifecycle.checkpoints.pickle_safety import MAX_PICKLE_BYTES, check_program
from yolov5_lifecycle.checkpoints.pickled_names import (
    ENCODE,
    GET_ATTRIBUTE,
    NUMPY_SCALARS,
    ORDERED_DICT,
    SETS,
    STORAGES,
)
from yolov5_lifecycle.checkpoints.stored_tensor import Storage, StoredTensor
from yolov5_lifecycle.models.model import WeightsError, first_line, shown

MAX_MODULES = 10_000
MAX_PATH_LENGTH = 200
_COUNTS = ("total_ops", "total_params")
"""Buffers that thop adds to every module to count its multiply-adds and parameters."""
_SCALARS = re.compile(r"b1|[iu][1248]|f[248]|U[1-9]\d?")
"""Types of scalars of numpy: truth values, numbers, and texts of up to 99 characters."""


class Stub:
    """Stub for an instance of a class named in the file: stores its state and does nothing."""

    pickled_name = ""

    def __new__(cls, *arguments: object) -> Stub:
        stub = object.__new__(cls)
        stub.arguments = arguments
        stub.state = {}
        return stub

    def __init__(self, *arguments: object) -> None:
        self.arguments: tuple[object, ...]
        self.state: Any

    def __setstate__(self, state: object) -> None:
        self.state = state

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


def unpickled(archive: Archive) -> object:
    """The object in data.pkl, with stubs and tensors not yet read; raises WeightsError unless it is data."""
    program = archive.record(PICKLE, MAX_PICKLE_BYTES + 1)
    return load_pickled(program, check_program(program))


def load_pickled(program: bytes, names: Iterable[str]) -> object:
    """The object in the pickle `program`, with stubs for the classes `names` and tensors not yet read.

    `program` must have passed `check_program`. Raises WeightsError.
    """
    stubs = {name: type(name, (Stub,), {"pickled_name": name}) for name in names}
    try:
        return _Unpickler(program, stubs).load()
    except WeightsError:
        raise
    except Exception as error:  # noqa: BLE001 - any error of a hostile pickle means rejection
        raise WeightsError(f"the pickle cannot be read ({first_line(error)}): copy it again") from None


class _Unpickler(pickle._Unpickler):
    """Unpickler that resolves names from its table only: nothing is imported.

    The C unpickler would allocate as many memo entries as the file claims; this one uses a dict.
    """

    def __init__(self, program: bytes, stubs: dict[str, Any]) -> None:
        super().__init__(io.BytesIO(program), encoding="latin1")
        self._table = stubs | dict(_TABLE)

    def find_class(self, module: str, name: str) -> Any:
        return self._table[f"{module}.{name}"]

    def persistent_load(self, pid: Any) -> object:
        _, dtype, key, _, elements = pid
        return Storage(key, dtype, elements)


def _scalar(dtype: object, content: object) -> object:
    """The number or text that a scalar of numpy is; a stub for one of another type."""
    if not isinstance(dtype, Stub) or not isinstance(dtype.state, tuple) or not isinstance(content, bytes):
        return Stub()
    kind, order = dtype.arguments[0], dtype.state[1]
    if not isinstance(kind, str) or not _SCALARS.fullmatch(kind) or order not in ("<", ">", "|"):
        return Stub()
    (scalar,) = np.frombuffer(content, f"{order}{kind}").tolist()
    return scalar


def _tensor(storage: Storage, offset: int, shape: Any, strides: Any, *_: object) -> StoredTensor:
    return StoredTensor(storage, offset, tuple(shape), tuple(strides))


class _Dict(OrderedDict[Any, Any]):
    """Replacement for pickled OrderedDicts; ignores pickled attributes, which could hide dict methods."""

    def __setstate__(self, state: object) -> None:
        pass


_TABLE: Mapping[str, object] = {
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": lambda data, *_: data,
    ORDERED_DICT: _Dict,
    **dict.fromkeys(NUMPY_SCALARS, _scalar),
    **dict.fromkeys(GET_ATTRIBUTE, lambda owner, name: None),
    ENCODE: lambda text, _: text.encode("latin1"),
    **dict.fromkeys(SETS, set),
    **STORAGES,
}
"""Objects for the names that `check_program` allows a pickle to call or refer to."""


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
