"""The module tree in a checkpoint, read with inert stand-ins: nothing in the file is run."""

from __future__ import annotations

import io
import pickletools
import re
import threading
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.serialization import safe_globals

from yolov5_lifecycle.checkpoint_archive import Archive
from yolov5_lifecycle.model import WeightsError, first_line, shown

MIN_TORCH = (2, 10)
"""weights_only=True itself could be broken before: CVE-2025-32434 (< 2.6), CVE-2026-24747 (< 2.10)."""
MAX_MODULES = 10_000
MAX_PATH_LENGTH = 200

# torch's own table is longer, but its bytearray and torch.FloatTensor allocate what the file tells them to.
_TORCH_NAMES = frozenset(
    {
        "__builtin__.set",
        "_codecs.encode",
        "builtins.set",
        "collections.OrderedDict",
        "torch.Size",
        "torch.device",
        "torch._utils._rebuild_parameter",
        "torch._utils._rebuild_tensor_v2",
        *(f"torch.{kind}Storage" for kind in ("BFloat16", "Bool", "Byte", "Char", "Double", "Float", "Half")),
        *(f"torch.{kind}Storage" for kind in ("Int", "Long", "Short")),
        *(f"torch.{kind}" for kind in ("bfloat16", "float16", "float32", "float64", "int64")),
    }
)
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
# Protocol 2 as torch writes it; STACK_GLOBAL, INST and the like cannot even be looked at.
_OPERATIONS = frozenset(
    [
        "PROTO", "STOP", "MARK", "GLOBAL", "NEWOBJ", "REDUCE", "BUILD", "BINPERSID", "APPEND",
        "APPENDS", "SETITEM", "SETITEMS", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "NONE",
        "NEWFALSE", "NEWTRUE", "EMPTY_TUPLE", "EMPTY_LIST", "EMPTY_DICT", "BININT", "BININT1",
        "BININT2", "BINFLOAT", "LONG1", "BINUNICODE", "SHORT_BINSTRING", "BINGET", "LONG_BINGET",
        "BINPUT", "LONG_BINPUT",
    ]
)  # fmt: skip
_SLOW_CODECS = frozenset({"idna", "punycode"})
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


def load_pickled(archive: Archive, *, device: str, torch_version: str = torch.__version__) -> object:
    """What the checkpoint's pickle describes, with stand-ins for all classes and tensors on `device`.

    On the device "meta" no tensor takes memory. Raises WeightsError.
    """
    if tuple(int(part) for part in torch_version.split(".")[:2]) < MIN_TORCH:
        raise WeightsError(
            f"reading a .pt safely needs torch 2.10 or newer, found {torch_version}: "
            "convert the file to .safetensors on a machine that has it (command `convert`)"
        )
    table = [
        (type(name, (StandIn,), {"pickled_name": name}), name)
        for name in _named(archive.pickle)
        if name not in _TORCH_NAMES
    ]
    try:
        with _TABLE, safe_globals(table):  # type: ignore[arg-type]
            # Never weights_only=False, not even as a second try: the file decides what fails.
            return torch.load(io.BytesIO(archive.data), map_location=device, weights_only=True)
    except Exception as error:  # noqa: BLE001 - whatever a hostile pickle provokes is a refusal
        raise WeightsError(f"the pickle cannot be read ({first_line(error)}): copy it again") from None


def _named(pickle: bytes) -> list[str]:
    """Every class and function that the pickle names; raises WeightsError if one of them is foreign."""
    names: set[str] = set()
    texts: set[str] = set()
    try:
        for operation, argument, _ in pickletools.genops(pickle):
            if operation.name not in _OPERATIONS:
                raise WeightsError(f"its pickle uses {operation.name}, as torch never does: do not trust it")
            if operation.name == "GLOBAL":
                names.add(str(argument).replace(" ", ".", 1))
            elif isinstance(argument, str) and len(argument) < 40:
                texts.add(re.sub("[^a-z]", "", argument.lower()))
            elif isinstance(argument, int) and abs(argument) >= 1 << 63:
                raise WeightsError(f"its pickle holds the number {shown(argument)}: do not trust it")
    except (ValueError, LookupError, UnicodeError) as error:
        if isinstance(error, WeightsError):
            raise
        raise WeightsError(f"the pickle is damaged or cut short ({first_line(error)})") from None
    if "_codecs.encode" in names and texts & _SLOW_CODECS:
        raise WeightsError("its pickle encodes texts in a way that numpy never does: do not trust it")
    _refuse_foreign(names)
    return sorted(names)


def _refuse_foreign(names: set[str]) -> None:
    if any(name.startswith("ultralytics.") for name in names):
        raise WeightsError(
            "this model belongs to the ultralytics package (YOLOv8 or later, or a YOLOv5 'u' model); "
            "expected a checkpoint trained by YOLOv5 itself (v6 or v7)"
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
