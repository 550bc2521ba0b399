"""Abstract interpreter for pickles that builds no objects, so that only harmless ones are unpickled.

An unpickler with an allowlist of names can still be made to exhaust memory or time: nested tuples as a
key take forever to hash, and `_codecs.encode(data, "hex")` doubles its input.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Union

from yolov5_lifecycle.checkpoints.pickle_opcodes import Operation, operations
from yolov5_lifecycle.checkpoints.pickled_names import (
    ENCODE,
    GET_ATTRIBUTE,
    NUMPY_SCALARS,
    ORDERED_DICT,
    SETS,
    STORAGES,
    TENSOR_MAKERS,
    TORCH_NAMES,
    stubs_among,
)
from yolov5_lifecycle.models.model import WeightsError, first_line, shown

MAX_PICKLE_BYTES = 4 << 20
"""data.pkl of yolov5n has 83 kB, that of an x6 training checkpoint with optimizer about 1 MB."""
MAX_CALLS = 100_000
"""yolov5n makes 4,000 calls, an x6 with its EMA and its optimizer about ten times as many."""
MAX_NAME = 500
"""Characters of the name of a class with its package, if the pickle makes it from texts."""
MAX_NAMES = 1_000
"""Different classes and functions; a training checkpoint names about 60."""
_MAX_ITEMS = 64
_MAX_MEMO = 500_000
"""Values kept for reuse, half of MAX_OPERATIONS: since protocol 4 each costs the file one byte."""

_SCALARS = ("NONE", "NEWFALSE", "NEWTRUE", "BININT", "BININT1", "BININT2", "BINFLOAT", "LONG1")
_TEXTS = ("BINUNICODE", "SHORT_BINUNICODE", "SHORT_BINSTRING")
_MADE = {
    "EMPTY_LIST": "list",
    "EMPTY_DICT": "dict",
    "BYTEARRAY8": "bytearray",
    **dict.fromkeys(("BINBYTES", "SHORT_BINBYTES"), "bytes"),
}
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def check_program(pickle: bytes) -> list[str]:
    """The classes that `pickle` names besides those of torch; raises WeightsError unless it only holds data.

    Names are told first: a foreign one is what its user must know. Of a pickle that is too large, the first
    `MAX_PICKLE_BYTES + 1` suffice.
    """
    program = _Program()
    failure: WeightsError | None = None
    try:
        for operation in operations(pickle):
            program.step(operation)
    except LookupError as error:
        failure = WeightsError(f"its pickle is damaged ({first_line(error)})")
    except WeightsError as error:
        failure = error
    stubs = stubs_among(program.names)
    if len(pickle) > MAX_PICKLE_BYTES:
        raise WeightsError(f"its pickle is too large: at most {MAX_PICKLE_BYTES} bytes are read")
    if failure is not None:
        raise failure from None
    return stubs


class _Thing:
    """Abstract value: its kind (list, dict, class, object ...), item count and whether all are plain."""

    __slots__ = ("is_plain", "kind", "size")

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.size = 0
        self.is_plain = True

    def fill(self, items: Sequence[_Value]) -> None:
        self.size += len(items)
        self.is_plain = self.is_plain and all(map(_is_plain, items))


_Value = Union[_Thing, str, tuple["_Value", ...]]  # noqa: UP007 - `|` does not accept a forward reference
_SCALAR = _Thing("number")


def _is_plain(value: _Value) -> bool:
    """Whether it takes no time to hash."""
    return isinstance(value, str) or (isinstance(value, _Thing) and value.kind == _SCALAR.kind)


class _Program:
    """The stack machine of pickle protocols 2 to 5, operating on kinds instead of values.

    `names` are the classes and functions named so far. All that torch does not define may make objects; the
    caller refuses foreign ones.
    """

    def __init__(self) -> None:
        self.names: set[str] = set()
        self._stack: list[_Value] = []
        self._below: list[list[_Value]] = []
        self._memo: dict[int, _Value] = {}
        self._calls = 0

    def step(self, operation: Operation) -> None:
        name = operation.name
        if name in _SCALARS:
            self._push(_SCALAR)
        elif name in _TEXTS:
            self._push(operation.text)
        elif name == "GLOBAL":
            self._name(operation.text)
        elif name in _MADE:
            self._push(_Thing(_MADE[name]))
        elif name in _TUPLES:
            self._push(tuple(self._pop(_TUPLES[name])))
        elif name in ("BINPUT", "LONG_BINPUT"):
            self._memorize(operation.number)
        elif name in ("BINGET", "LONG_BINGET"):
            self._push(self._memo[operation.number])
        else:
            self._ACTIONS[name](self)

    def _memorize(self, index: int) -> None:
        self._memo[index] = self._stack[-1]
        if len(self._memo) > _MAX_MEMO:
            raise WeightsError(f"its pickle refers to more than {_MAX_MEMO} of its values")

    def _name_on_stack(self) -> None:
        module, attribute = self._pop(2)
        if not isinstance(module, str) or not isinstance(attribute, str):
            raise WeightsError("its pickle has a name that is not text, which torch.save never does")
        # Before they are joined: a few bytes name what is in the memo again, however long it is.
        if len(module) + len(attribute) > MAX_NAME:
            raise WeightsError(f"its pickle has a name of more than {MAX_NAME} characters: do not trust it")
        self._name(f"{module}.{attribute}")

    def _name(self, name: str) -> None:
        self.names.add(name)
        if len(self.names) > MAX_NAMES:
            raise WeightsError(f"its pickle names more than {MAX_NAMES} classes: do not trust it")
        self._push(_Thing(name))

    def _mark(self) -> None:
        self._below.append(self._stack)
        self._stack = []

    def _push(self, value: _Value) -> None:
        self._stack.append(value)

    def _pop(self, count: int) -> list[_Value]:
        start = len(self._stack) - count
        if start < 0:
            raise IndexError("nothing on the stack")
        popped = self._stack[start:]
        del self._stack[start:]
        return popped

    def _pop_to_mark(self) -> list[_Value]:
        popped, self._stack = self._stack, self._below.pop()
        return popped

    def _top(self, *kinds: str) -> _Thing:
        top = self._stack[-1]
        if not isinstance(top, _Thing) or top.kind not in kinds:
            raise WeightsError(f"its pickle changes a {_kind(top)}, which torch.save never does")
        return top

    def _fill_list(self, items: Sequence[_Value]) -> None:
        self._top("list").fill(items)

    def _fill_dict(self, items: Sequence[_Value]) -> None:
        if not all(map(_is_plain, items[::2])):
            raise WeightsError("its pickle has a dict with keys that are neither text nor numbers")
        self._top("dict").fill(items)

    def _new_set(self) -> None:
        self._count()  # an empty set takes four times as much memory as an empty list
        self._push(_Thing("set"))

    def _fill_set(self, items: Sequence[_Value]) -> None:
        top = self._top("set")
        top.fill(items)
        if not top.is_plain or top.size > _MAX_ITEMS:
            raise WeightsError(
                f"its pickle has a set of more than {_MAX_ITEMS} items, or of others than texts and numbers"
            )

    def _new(self) -> None:
        cls, _ = self._called()
        if not self._is_stub(cls):
            raise WeightsError(f"its pickle creates a {shown(cls)}, which torch.save never does")
        self._push(_Thing("object"))

    def _call(self) -> None:
        name, arguments = self._called()
        kind = self._result(name, arguments)
        if kind is None:
            raise WeightsError(
                f"its pickle calls {shown(name)} in a way that no YOLOv5 checkpoint needs: do not trust it"
            )
        self._push(_Thing(kind))

    def _count(self) -> None:
        self._calls += 1
        if self._calls > MAX_CALLS:
            raise WeightsError(f"its pickle creates more than {MAX_CALLS} objects")

    def _called(self) -> tuple[str, tuple[_Value, ...]]:
        self._count()
        function, arguments = self._pop(2)
        if not isinstance(function, _Thing) or not isinstance(arguments, tuple):
            raise WeightsError("its pickle calls something that is not a function")
        return function.kind, arguments

    def _is_stub(self, name: str) -> bool:
        """Whether the value named so is a class that becomes a stub: no kind of value is named."""
        return name in self.names and name not in TORCH_NAMES

    def _result(self, name: str, arguments: tuple[_Value, ...]) -> str | None:
        """The kind of object that a call returns; None if the call is forbidden."""
        if self._is_stub(name):
            return "object"
        if name in TENSOR_MAKERS and len(arguments) <= 8:
            return "tensor"
        if name in NUMPY_SCALARS and len(arguments) == 2:
            return _SCALAR.kind
        if name == ORDERED_DICT and not arguments:
            return "dict"
        if name == ENCODE and len(arguments) == 2 and isinstance(arguments[0], str):
            return "bytes" if arguments[1] == "latin1" else None
        if name in GET_ATTRIBUTE and _is_known_method(*arguments):
            return "method"
        if name in SETS and len(arguments) == 1 and _is_short_plain_list(arguments[0]):
            return "set"
        return None

    def _build(self) -> None:
        (state,) = self._pop(1)
        target = self._top("object", "dict")
        # torch copies this state, so it must be as small as the `_metadata` of a state dict.
        if target.kind == "dict" and not (isinstance(state, _Thing) and state.size <= _MAX_ITEMS):
            raise WeightsError("its pickle gives a dict attributes, which torch.save never does")

    def _storage(self) -> None:
        (pid,) = self._pop(1)
        if not isinstance(pid, tuple) or len(pid) != 5 or not _is_storage(*pid):
            raise WeightsError("its pickle refers to a storage in a way that torch.save never does")
        self._push(_Thing("storage"))

    _ACTIONS: ClassVar[Mapping[str, Callable[[_Program], None]]] = {
        "PROTO": lambda _: None,
        "FRAME": lambda _: None,
        "MEMOIZE": lambda self: self._memorize(len(self._memo)),
        "STACK_GLOBAL": _name_on_stack,
        "EMPTY_SET": _new_set,
        "ADDITEMS": lambda self: self._fill_set(self._pop_to_mark()),
        "MARK": _mark,
        "TUPLE": lambda self: self._push(tuple(self._pop_to_mark())),
        "APPEND": lambda self: self._fill_list(self._pop(1)),
        "APPENDS": lambda self: self._fill_list(self._pop_to_mark()),
        "SETITEM": lambda self: self._fill_dict(self._pop(2)),
        "SETITEMS": lambda self: self._fill_dict(self._pop_to_mark()),
        "NEWOBJ": _new,
        "REDUCE": _call,
        "BUILD": _build,
        "BINPERSID": _storage,
        "STOP": lambda self: self._pop(1).clear(),
    }
    """What the other operations do. Bound methods of an object in itself would keep its memo alive."""


def _kind(value: _Value) -> str:
    return value.kind[:80] if isinstance(value, _Thing) else type(value).__name__


def _is_short_plain_list(value: _Value) -> bool:
    return isinstance(value, _Thing) and value.kind == "list" and value.is_plain and value.size <= _MAX_ITEMS


def _is_known_method(owner: _Value = "", method: _Value = "", *more: _Value) -> bool:
    """Whether it is `forward` of the class Detect or that of a fused object; neither is resolved."""
    if more or not isinstance(owner, _Thing):
        return False
    if owner.kind == "object":
        return method in ("forward_fuse", "fuseforward")
    return owner.kind.removeprefix("yolov5.") == "models.yolo.Detect" and method == "forward"


def _is_storage(marker: _Value, kind: _Value, key: _Value, location: _Value, elements: _Value) -> bool:
    return (
        marker == "storage"
        and isinstance(kind, _Thing)
        and kind.kind in STORAGES
        and isinstance(key, str)
        and isinstance(location, str)
        and elements is _SCALAR
    )
