"""Interpreter of checkpoint pickles: nothing is imported or called, what comes of a pickle is data.

An unpickler with an allowlist of names can still be made to exhaust memory or time: nested tuples as a
key take forever to hash, and `_codecs.encode(data, "hex")` doubles its input.
"""

from __future__ import annotations

import io
import pickletools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from yolov5_lifecycle.checkpoints.archive import PICKLE, Archive
from yolov5_lifecycle.checkpoints.pickled_objects import (
    ENCODE,
    GET_ATTRIBUTE,
    NUMPY_SCALARS,
    ORDERED_DICT,
    PARAMETER_MAKER,
    SETS,
    STORAGES,
    TENSOR_MAKER,
    TORCH_NAMES,
    Storage,
    StoredTensor,
    Stub,
    check_names,
)
from yolov5_lifecycle.models.model import WeightsError, first_line, shown

MAX_PICKLE_BYTES = 4 << 20
"""data.pkl of yolov5n has 83 kB, that of an x6 training checkpoint with optimizer about 1 MB."""
MAX_OPERATIONS = 1_000_000
"""yolov5n has a thirtieth of it, an x6 with its EMA and its optimizer a third."""
MAX_CALLS = 100_000
"""yolov5n makes 4,000 calls, an x6 with its EMA and its optimizer about ten times as many."""
MAX_NAME = 500
"""Characters of the name of a class with its package, if the pickle makes it from texts."""
MAX_NAMES = 1_000
"""Different classes and functions; a training checkpoint names about 60."""
_MAX_ITEMS = 64
_MAX_MEMO = 500_000
"""Values kept for reuse, half of MAX_OPERATIONS: since protocol 4 each costs the file one byte."""
_MAX_PROTOCOL = 5

_OPERATIONS = {ord(operation.code): operation for operation in pickletools.opcodes}
_NUMPY_SCALAR = re.compile(r"b1|[iu][1248]|f[248]|U[1-9]\d?")
"""Types of scalars of numpy: truth values, numbers, and texts of up to 99 characters."""


def unpickled(archive: Archive) -> object:
    """The object in data.pkl, of data, stubs, and tensors not yet read; raises WeightsError.

    Names are told first: a foreign one is what its user must know. Of a pickle that is too large, the first
    `MAX_PICKLE_BYTES + 1` bytes suffice.
    """
    pickle = archive.record(PICKLE, MAX_PICKLE_BYTES + 1)
    interpreter = _Interpreter(pickle)
    found, failure = None, None
    try:
        found = interpreter.run()
    except MemoryError:  # says nothing of the file
        raise
    except WeightsError as error:
        failure = error
    except LookupError as error:
        failure = WeightsError(f"its pickle is damaged ({first_line(error)})")
    except Exception as error:  # noqa: BLE001 - any error of a hostile pickle means rejection
        failure = WeightsError(f"the pickle cannot be read ({first_line(error)}): copy it again")
    check_names(interpreter.names)
    if len(pickle) > MAX_PICKLE_BYTES:
        raise WeightsError(f"its pickle is too large: at most {MAX_PICKLE_BYTES} bytes are read")
    if failure is not None:
        raise failure from None
    return found


@dataclass(frozen=True)
class _Name:
    """A class or function, which is only named."""

    text: str


class _Interpreter:
    """The stack machine of pickle protocols 2 to 5, with the operations that torch.save writes.

    `names` are the classes and functions named so far. All that torch does not define may make stubs; the
    caller refuses foreign ones.
    """

    def __init__(self, pickle: bytes) -> None:
        self.names: dict[str, _Name] = {}
        self._stream = io.BytesIO(pickle)
        self._frame_end = 0
        self._stack: list[Any] = []
        self._below: list[list[Any]] = []
        self._memo: dict[int, Any] = {}
        self._stubs: dict[str, type[Stub]] = {}
        self._calls = 0
        self._encoded_bytes = 0

    def run(self) -> object:
        """The value on the stack at STOP; raises WeightsError, LookupError, or what bad values raise."""
        for _ in range(MAX_OPERATIONS):
            begin = self._stream.tell()
            operation, argument = self._read()
            if begin < self._frame_end < self._stream.tell():
                raise WeightsError("its pickle cannot be read: a frame ends within a value: copy it again")
            if operation == "STOP":
                return self._pop(1)[0]
            self._ACTIONS[operation](self, argument)
        raise WeightsError(f"its pickle has more than {MAX_OPERATIONS} operations")

    def _read(self) -> tuple[str, Any]:
        """The next operation and its argument.

        Replaces `pickletools.genops`, which interprets escapes in names although no unpickler does.
        """
        code = self._stream.read(1)
        if not code:
            raise WeightsError("its pickle is damaged: it is cut short")
        operation = _OPERATIONS.get(code[0])
        if operation is None or (operation.name != "STOP" and operation.name not in self._ACTIONS):
            name = operation.name if operation else f"the byte {code[0]}"
            raise WeightsError(f"its pickle uses {name}, which torch.save never does: do not trust it")
        try:
            if operation.name == "GLOBAL":
                return operation.name, (self._line(), self._line())
            return operation.name, operation.arg.reader(self._stream) if operation.arg else None
        except UnicodeDecodeError:
            raise WeightsError("its pickle is damaged: it contains an invalid string") from None
        except ValueError:
            raise WeightsError("its pickle is cut short") from None

    def _line(self) -> str:
        line = self._stream.readline()
        if not line.endswith(b"\n"):
            raise ValueError("no end of the line")
        return line[:-1].decode()

    def _begin_frame(self, size: int) -> None:
        """A frame is a size to read ahead, nothing else: its operations follow as without it."""
        begin = self._stream.tell()
        if begin < self._frame_end:
            raise WeightsError("its pickle cannot be read: it has a frame in a frame: copy it again")
        if size > len(self._stream.getbuffer()) - begin:
            raise WeightsError("its pickle is cut short")
        self._frame_end = begin + size

    def _memorize(self, index: int) -> None:
        self._memo[index] = self._stack[-1]
        if len(self._memo) > _MAX_MEMO:
            raise WeightsError(f"its pickle refers to more than {_MAX_MEMO} of its values")

    def _name_on_stack(self, _: object) -> None:
        module, attribute = self._pop(2)
        if not isinstance(module, str) or not isinstance(attribute, str):
            raise WeightsError("its pickle has a name that is not text, which torch.save never does")
        # Before they are joined: a few bytes name what is in the memo again, however long it is.
        if len(module) + len(attribute) > MAX_NAME:
            raise WeightsError(f"its pickle has a name of more than {MAX_NAME} characters: do not trust it")
        self._name(module, attribute)

    def _name(self, module: str, attribute: str) -> None:
        name = f"{module}.{attribute}"
        self._push(self.names.setdefault(name, _Name(name)))
        if len(self.names) > MAX_NAMES:
            raise WeightsError(f"its pickle names more than {MAX_NAMES} classes: do not trust it")

    def _mark(self, _: object) -> None:
        self._below.append(self._stack)
        self._stack = []

    def _push(self, value: object) -> None:
        self._stack.append(value)

    def _pop(self, count: int) -> list[Any]:
        start = len(self._stack) - count
        if start < 0:
            raise IndexError("nothing on the stack")
        popped = self._stack[start:]
        del self._stack[start:]
        return popped

    def _pop_to_mark(self) -> list[Any]:
        popped, self._stack = self._stack, self._below.pop()
        return popped

    def _top(self, *kinds: type) -> Any:
        top = self._stack[-1]
        if not isinstance(top, kinds):
            kind = _KINDS.get(type(top), type(top).__name__)
            raise WeightsError(f"its pickle changes a {kind}, which torch.save never does")
        return top

    def _fill_list(self, items: Sequence[object]) -> None:
        self._top(list).extend(items)

    def _fill_dict(self, items: Sequence[object]) -> None:
        if not all(map(_is_plain, items[::2])):
            raise WeightsError("its pickle has a dict with keys that are neither text nor numbers of 64 bits")
        self._top(dict).update(zip(items[::2], items[1::2], strict=True))

    def _new_set(self, _: object) -> None:
        self._count()  # an empty set takes four times as much memory as an empty list
        self._push(set())

    def _fill_set(self, items: Sequence[object]) -> None:
        top = self._top(set)
        if len(top) + len(items) > _MAX_ITEMS or not all(map(_is_plain, items)):
            raise WeightsError(
                f"its pickle has a set of more than {_MAX_ITEMS} items, or of others than texts and numbers"
            )
        top.update(items)

    def _new(self, _: object) -> None:
        name, arguments = self._called()
        if not self._is_stub(name):
            raise WeightsError(f"its pickle creates a {shown(name)}, which torch.save never does")
        self._push(self._stub(name, arguments))

    def _call(self, _: object) -> None:
        name, arguments = self._called()
        if self._is_stub(name):
            self._push(self._stub(name, arguments))
            return
        function = self._FUNCTIONS.get(name)
        returned = NotImplemented if function is None else function(self, arguments)
        if returned is NotImplemented:
            raise WeightsError(
                f"its pickle calls {shown(name)} in a way that no YOLOv5 checkpoint needs: do not trust it"
            )
        self._push(returned)

    def _count(self) -> None:
        self._calls += 1
        if self._calls > MAX_CALLS:
            raise WeightsError(f"its pickle creates more than {MAX_CALLS} objects")

    def _called(self) -> tuple[str, tuple[object, ...]]:
        self._count()
        function, arguments = self._pop(2)
        if not isinstance(function, _Name) or not isinstance(arguments, tuple):
            raise WeightsError("its pickle calls something that is not a function")
        return function.text, arguments

    def _stub(self, name: str, arguments: tuple[object, ...]) -> Stub:
        """A stub whose class has the name, which is what a message tells of an object."""
        if name not in self._stubs:
            self._stubs[name] = type(name, (Stub,), {})
        return self._stubs[name](name, arguments)

    def _is_stub(self, name: str) -> bool:
        """Whether the value named so is a class that becomes a stub: a method has no such name."""
        return name in self.names and name not in TORCH_NAMES

    def _encoded(self, arguments: tuple[object, ...]) -> object:
        """Bytes, which protocol 2 has as texts: one from the memo, encoded often, would fill the memory."""
        match arguments:
            case (str(text), "latin1"):
                self._encoded_bytes += len(text)
                if self._encoded_bytes > MAX_PICKLE_BYTES:
                    raise WeightsError(f"its pickle encodes more than {MAX_PICKLE_BYTES} bytes")
                return text.encode("latin1")
        return NotImplemented

    def _build(self, _: object) -> None:
        (state,) = self._pop(1)
        target = self._top(Stub, dict)
        if isinstance(target, Stub):  # attributes of a dict are dropped: they could hide its methods
            target.state = state

    def _storage(self, _: object) -> None:
        match self._pop(1):
            case [("storage", _Name(kind), str(key), str(), elements)] if kind in STORAGES:
                self._push(Storage(key, STORAGES[kind], elements))
            case _:
                raise WeightsError("its pickle refers to a storage in a way that torch.save never does")

    _FUNCTIONS: ClassVar[Mapping[str, Callable[[_Interpreter, tuple[Any, ...]], object]]] = {
        TENSOR_MAKER: lambda _, arguments: _tensor(*arguments),
        PARAMETER_MAKER: lambda _, arguments: arguments[0],
        ORDERED_DICT: lambda _, arguments: NotImplemented if arguments else {},
        ENCODE: _encoded,
        **dict.fromkeys(NUMPY_SCALARS, lambda _, arguments: _scalar(arguments)),
        **dict.fromkeys(GET_ATTRIBUTE, lambda _, arguments: _method(arguments)),
        **dict.fromkeys(SETS, lambda _, arguments: _set(arguments)),
    }
    """What the functions return that torch.save calls; NotImplemented for arguments that it never passes."""
    _ACTIONS: ClassVar[Mapping[str, Callable[[_Interpreter, Any], None]]] = {
        **dict.fromkeys(
            (
                *("BININT", "BININT1", "BININT2", "BINFLOAT", "LONG1", "BINUNICODE", "SHORT_BINUNICODE"),
                *("SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BYTEARRAY8"),
            ),
            _push,
        ),
        "NONE": lambda self, _: self._push(None),
        "NEWFALSE": lambda self, _: self._push(False),
        "NEWTRUE": lambda self, _: self._push(True),
        "EMPTY_LIST": lambda self, _: self._push([]),
        "EMPTY_DICT": lambda self, _: self._push({}),
        "EMPTY_SET": _new_set,
        "EMPTY_TUPLE": lambda self, _: self._push(()),
        "TUPLE1": lambda self, _: self._push(tuple(self._pop(1))),
        "TUPLE2": lambda self, _: self._push(tuple(self._pop(2))),
        "TUPLE3": lambda self, _: self._push(tuple(self._pop(3))),
        "TUPLE": lambda self, _: self._push(tuple(self._pop_to_mark())),
        "MARK": _mark,
        "BINPUT": _memorize,
        "LONG_BINPUT": _memorize,
        "MEMOIZE": lambda self, _: self._memorize(len(self._memo)),
        "BINGET": lambda self, index: self._push(self._memo[index]),
        "LONG_BINGET": lambda self, index: self._push(self._memo[index]),
        "APPEND": lambda self, _: self._fill_list(self._pop(1)),
        "APPENDS": lambda self, _: self._fill_list(self._pop_to_mark()),
        "SETITEM": lambda self, _: self._fill_dict(self._pop(2)),
        "SETITEMS": lambda self, _: self._fill_dict(self._pop_to_mark()),
        "ADDITEMS": lambda self, _: self._fill_set(self._pop_to_mark()),
        "GLOBAL": lambda self, names: self._name(*names),
        "STACK_GLOBAL": _name_on_stack,
        "NEWOBJ": _new,
        "REDUCE": _call,
        "BUILD": _build,
        "BINPERSID": _storage,
        "PROTO": lambda _, protocol: _check_protocol(protocol),
        "FRAME": _begin_frame,
    }
    """The operations of torch.save besides STOP."""


def _check_protocol(protocol: int) -> None:
    if not 2 <= protocol <= _MAX_PROTOCOL:
        raise WeightsError(
            f"its pickle is of protocol {protocol}, expected 2 to {_MAX_PROTOCOL}: save the model again with "
            "torch.save(..., pickle_protocol=2)"
        )


def _is_plain(value: object) -> bool:
    """Whether it takes no time as a key: of longer numbers, any count may have one and the same hash."""
    if isinstance(value, int):
        return value.bit_length() < 64
    return value is None or isinstance(value, (str, float))


def _tensor(storage: Storage, offset: int, shape: Any, strides: Any, *_: object) -> StoredTensor:
    return StoredTensor(storage, offset, tuple(shape), tuple(strides))


def _scalar(arguments: tuple[object, ...]) -> object:
    """The number or text that a scalar of numpy is; a stub for one of another type."""
    match arguments:
        case (Stub(arguments=(str(kind), *_), state=(_, "<" | ">" | "|" as order, *_)), bytes(content)) if (
            _NUMPY_SCALAR.fullmatch(kind)
        ):
            (scalar,) = np.frombuffer(content, f"{order}{kind}").tolist()
            return scalar
        case (_, _):
            return Stub("")
    return NotImplemented


def _method(arguments: tuple[object, ...]) -> object:
    """`forward` of the class Detect, or that of a fused object; neither is resolved."""
    match arguments:
        case (_Name("models.yolo.Detect" | "yolov5.models.yolo.Detect"), "forward"):
            return _METHOD
        case (Stub(), "forward_fuse" | "fuseforward"):
            return _METHOD
    return NotImplemented


def _set(arguments: tuple[object, ...]) -> object:
    match arguments:
        case (list(items),) if len(items) <= _MAX_ITEMS and all(map(_is_plain, items)):
            return set(items)
    return NotImplemented


_METHOD = _Name("method")
_KINDS: Mapping[type, str] = {StoredTensor: "tensor", Storage: "storage", _Name: "name"}
