"""Checkpoints whose pickle calls what no checkpoint needs, costs memory or time, or has odd tensors."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator

from support import pickle_assembler as asm
from support.checkpoint_builder import in_one_storage, layers_of, official_model, saved, stripped
from support.pickle_assembler import (
    APPEND,
    EMPTY_DICT,
    EMPTY_LIST,
    EMPTY_SET,
    MARK,
    SETITEM,
    archive,
    call,
    get,
    instance,
    items,
    mapping,
    model,
    name,
    number,
    put,
    stacked_name,
    storage,
    tensor,
    text,
)

Case = tuple[str, bytes, str]
"""Its name, the file, and what the refusal says."""
MARKER = "hostile_marker"
"""A module that a test puts on the path; importing it leaves a trace."""
SHELL = text(f"{MARKER}=1; touch {MARKER}")
DETECT, CONV = name("models.yolo", "Detect"), name("models.common", "Conv")
NO_CHECKPOINT = "expected a dict with the entry 'model'"

FOREIGN = (
    ("os", "system", SHELL),
    (MARKER, "anything", b""),
    ("torch", "load", text("/etc/passwd")),
    ("builtins", "bytearray", number(1 << 34)),
    ("yolov5_lifecycle.process.memory", "release_unused_memory", b""),
)
"""Functions that a pickle calls, one of each kind, by module, name and argument."""

METHODS = {
    "another method": (DETECT, text("__subclasses__")),
    "a method of an object": (instance("models.common", "Conv", {}), text("__class__")),
    "a method of another class": (CONV, text("forward")),
    "a method of a text": (text("x"), text("forward_fuse")),
    "no method": (),
}
"""Arguments of getattr."""

VALUES: dict[str, tuple[bytes, str]] = {
    "a method that is called": (
        call(name("__builtin__", "getattr"), DETECT, text("forward")) + items() + asm.REDUCE,
        "calls 'method'",
    ),
    "a name that looks like a layer": (name("models.yolo os", "system"), "do not trust"),
    "a name that is too long": (
        text("os") + text("x" * 500) + asm.STACK_GLOBAL,
        "a name of more than 500 characters",
    ),
    "a name with an escape": (name("models.y\\x6flo", "Model"), "do not trust"),
    "a name as protocol 4 writes it, in a frame": (
        asm.frame(stacked_name("os", "system") + items(SHELL) + asm.REDUCE),
        "'os.system'",
    ),
    "a module from the memo, whose place was counted": (
        EMPTY_LIST
        + (MARK + text("models.yolo") + asm.MEMOIZE + text("os") + asm.MEMOIZE)
        + (get(1) + text("system") + asm.STACK_GLOBAL + items(SHELL) + asm.REDUCE + b"e"),
        "'os.system'",
    ),
    "a method by its dotted name": (stacked_name("models.yolo", "Detect.forward.__globals__"), NO_CHECKPOINT),
    "an attribute of what torch has": (
        stacked_name("torch._utils", "_rebuild_tensor_v2.__globals__"),
        "'torch._utils._rebuild_tensor_v2.__globals__'",
    ),
    "a name of bytes": (
        asm.short_bytes(b"os") + text("system") + asm.STACK_GLOBAL,
        "a name that is not text",
    ),
    "a name after another one": (
        stacked_name("models.yolo", "Model") + text("system") + asm.STACK_GLOBAL,
        "a name that is not text",
    ),
    "INST of Python 1": (b"(" + SHELL + b"ios\nsystem\n", "INST"),
    "persistent text": (b"Pos.system\n", "PERSID"),
    "a text that is called": (text("os.system") + items(SHELL) + b"R", "calls something"),
    "a function in the place of a class": (
        name("torch._utils", "_rebuild_tensor_v2") + items() + asm.NEWOBJ,
        "creates a 'torch._utils._rebuild_tensor_v2'",
    ),
    "a model after torch.compile": (
        mapping({"model": name("torch._dynamo.eval_frame", "OptimizedModule")})
        + mapping({"more": name("contextlib", "nullcontext"), "most": name("torch", "_TorchCompileWrapper")}),
        "after torch.compile and names 'torch._dynamo.eval_frame.OptimizedModule', a part of the compiler",
    ),
    "an array of 16 EiB": (asm.byte_array(b"abc", claimed=(1 << 64) - 1), "cut short"),
    "a text that is not UTF-8": (b"X\x02\x00\x00\x00\xff\xff", "contains an invalid string"),
    "a text of 16 EiB": (b"\x8d" + b"\xff" * 8 + b"abc", "uses BINUNICODE8"),
    "a frame of 16 EiB": (asm.frame(mapping({}), claimed=(1 << 64) - 1), "cut short"),
    "a frame in a frame": (asm.frame(asm.frame(mapping({})) + mapping({})), "cannot be read"),
    "a frame that ends within a text": (asm.frame(text("models"), claimed=8), "cannot be read"),
    "a pickle without an end": (MARK * 1000, "is damaged"),
    "a memo that was never written": (get(5), "damaged"),
    "a memo entry number of 4 billion": (
        mapping({"model": text("x") + put(2**32 - 1)}),
        "expected a YOLOv5 model",
    ),
    "an item added to a model": (
        instance("models.yolo", "Model", {}) + MARK + number(1) + asm.ADDITEMS,
        "changes a models.yolo.Model",
    ),
    "an item set in a set": (
        call(name("__builtin__", "set"), EMPTY_LIST) + text("a") + text("b") + SETITEM,
        "changes a set",
    ),
    "a tensor that is built again": (tensor() + items(number(1), number(2)) + asm.BUILD, "changes a tensor"),
    "a dict whose methods are hidden": (
        mapping({"model": instance("models.yolo", "Model", {
            "_modules": call(name("collections", "OrderedDict")) + mapping({"items": number(5)}) + asm.BUILD
        })}),
        "without layers",
    ),
    "a class in the place of a module": (
        mapping({"model": instance("models.yolo", "Model", {"_modules": mapping({"model": DETECT})})}),
        "expected modules below",
    ),
    "parameters that are a list": (
        mapping({"model": instance("models.yolo", "Model", {"_parameters": EMPTY_LIST})}),
        "expected a dict as _parameters",
    ),
    "a number of 2,000 bits": (mapping({"model": number(1 << 2000)}), "expected a YOLOv5 model"),
    "bytes as a key": (EMPTY_DICT + asm.short_bytes(b"model") + number(1) + SETITEM, "keys that are neither"),
    "a set of 65 items": (
        EMPTY_SET + MARK + b"".join(map(number, range(65))) + asm.ADDITEMS,
        "has a set of more than 64 items",
    ),
    "lists, 20,000 deep": (EMPTY_LIST * 20_000 + APPEND * 19_999, NO_CHECKPOINT),
    "tuples, 20,000 deep": (asm.EMPTY_TUPLE + b"\x85" * 20_000, NO_CHECKPOINT),
    "a text doubled 40 times": (
        call(name("_codecs", "encode"), text("x" * 200), text("hex"))
        + (put(0) + call(name("_codecs", "encode"), get(0), text("hex"))) * 40,
        "calls '_codecs.encode'",
    ),
}  # fmt: skip
"""What a data.pkl leaves on the stack."""

TENSORS: dict[str, tuple[bytes, str]] = {
    "4 Ti numbers in 16 bytes": (tensor((1 << 42,)), "tensors claim"),
    "stride 0": (tensor((1 << 40,), (0,)), "has the strides"),
    "negative stride": (tensor((4,), (-1,)), "cannot be read"),
    "a size that no number of bytes has": (tensor((0, 1 << 61, 1 << 61), (1, 1, 1)), "has the shape"),
    "negative size": (tensor((-4,)), "cannot be read"),
    "a storage of 1 Ti numbers": (tensor(stored=storage(1 << 40)), "claims 4398046511104 bytes, but has 16"),
    "a storage of no numbers": (tensor(stored=storage(0)), "number 3 of 0"),
    "a storage of half a number": (
        tensor(stored=storage(numel=b"G" + struct.pack(">d", 0.5))),
        "a tensor has the size 0.5",
    ),
    "an offset behind the end": (tensor((1,), offset=4), "number 4 of 4"),
    "an offset before the beginning": (tensor((1,), offset=-1), "a tensor has the size -1"),
    "more strides than sizes": (tensor((4,), (1, 1)), "has the strides [1, 1]"),
    "a storage that is not there": (
        tensor(stored=storage(key="../../version")),
        "the storage '../../version' is missing",
    ),
    "bytes as weights": (tensor(stored=storage(16, kind="ByteStorage")), "holds torch.uint8"),
}
"""The only parameter of a model, beside a storage of 16 bytes."""


def hostile_pickles() -> Iterator[Case]:
    for module, function, argument in FOREIGN:
        value = mapping({"model": call(name(module, function), argument)})
        yield f"{module}.{function}", archive(value), f"'{module}.{function}'"
    for label, arguments in METHODS.items():
        yield label, archive(call(name("builtins", "getattr"), *arguments)), "calls 'builtins.getattr'"
    for label, (value, told) in VALUES.items():
        yield label, archive(value), told
    for label, (value, told) in TENSORS.items():
        yield label, archive(model(value)), told
    for protocol in (1, 6):
        start = b"\x80" + bytes([protocol])
        yield f"protocol {protocol}", archive(mapping({}), start=start), f"of protocol {protocol}, expected 2"
    yield "an empty pickle", archive(b"", start=b""), "damaged"
    yield from _bombs()
    yield from _large_tensors()


def _bombs() -> Iterator[Case]:
    """What would take up memory or time if it were built."""
    made_set = name("__builtin__", "set")
    yield "laughs as a key", archive(UNUSED_LAUGHS + LAUGHS + b"Ns"), "keys that are neither"
    in_a_list = call(made_set, EMPTY_LIST + LAUGHS + APPEND)
    yield "laughs as an item of a set made of a list", laughing(in_a_list), "calls '__builtin__.set'"
    in_a_set = EMPTY_SET + MARK + LAUGHS + asm.ADDITEMS
    yield "laughs as an item of a set", laughing(in_a_set), "has a set of more than 64 items, or of others"
    yield "laughs as the model", laughing(LAUGHS), "expected a YOLOv5 model"
    stored = items(text("storage"), name("torch", "FloatStorage"), LAUGHS, text("cpu"), number(4))
    yield "laughs as the storage", laughing(stored + asm.PERSID), "refers to"
    encode = name("_codecs", "encode") + put(0) + APPEND
    encode += items(text("x" * 2_000_000), text("latin1")) + put(1) + APPEND
    often = EMPTY_LIST + encode + (get(0) + get(1) + asm.REDUCE + APPEND) * 90_000
    yield "a text of two megabytes, encoded often", archive(often), "encodes more than 4194304 bytes"
    keys = (number(index * (2**61 - 1)) + text("") for index in range(40_000))
    yield (
        "a dict of numbers that have one hash",
        archive(EMPTY_DICT + MARK + b"".join(keys) + b"u"),
        "keys that are neither text nor numbers of 64 bits",
    )
    for length, told in ((1_000_000, "a name of more than 500 characters"), (240, NO_CHECKPOINT)):
        texts = text("models." + "x" * length) + put(1) + APPEND + text("y" * length) + put(2) + APPEND
        names = (get(1) + get(2) + asm.STACK_GLOBAL + APPEND) * 150_000
        yield f"a name of {2 * length} characters, often", archive(EMPTY_LIST + texts + names), told
    named = b"".join(name("models", f"{n:x}") for n in range(100_000))
    yield "names without end", archive(EMPTY_LIST + MARK + named + b"e"), "names more than 1000 classes"
    items_65 = EMPTY_LIST + MARK + b"".join(map(number, range(65))) + b"e"
    yield "a set of a list of 65 items", archive(call(made_set, items_65)), "calls '__builtin__.set'"
    yield (
        "a dict of a list",
        archive(call(name("collections", "OrderedDict"), EMPTY_LIST)),
        "calls 'collections.OrderedDict'",
    )
    yield "a million lists", archive(EMPTY_LIST * 1_100_000), "more than 1000000 operations"
    yield "a million sets", archive(EMPTY_SET * 990_000), "creates more than 100000 objects"
    yield "a million memos", archive(EMPTY_LIST + asm.MEMOIZE * 990_000), "refers to more than 500000 of its"
    objects = CONV + put(0) + APPEND + MARK + (get(0) + asm.EMPTY_TUPLE + asm.NEWOBJ) * 110_000 + b"e"
    yield "too many objects", archive(EMPTY_LIST + objects), "more than 100000 objects"
    yield "modules, 1,000 deep", nested_modules(1_000), "contains itself"
    inside = name("models.yolo", "Model") + asm.EMPTY_TUPLE + asm.NEWOBJ + put(7)
    inside += mapping({"_modules": mapping({"m": get(7)})}) + asm.BUILD
    yield "a module that contains itself", archive(mapping({"model": inside})), "contains itself"
    yield "2 ** 60 modules", all_in_all_modules(60), "more than 10000 modules"
    yield "a pickle of 5 MB", archive(text("x" * 5_000_000)), "at most 4194304 bytes are read"


def _large_tensors() -> Iterator[Case]:
    unused = archive(model(tensor()), storages=(bytes(16), bytes(66 << 20)))
    yield "66 MiB that no layer uses", unused, "bytes that belong to no layer"
    views = {f"weight{index}": tensor((1 << 20,), stored=storage(1 << 20)) for index in range(50)}
    shared = mapping({"model": instance("models.yolo", "Model", {"_parameters": mapping(views)})})
    yield "tensors that share one storage", archive(shared, storages=[bytes(4 << 20)]), "tensors claim"
    whole = in_one_storage(official_model(), spare=10 << 20)
    vars(layers_of(whole)["0"])["_modules"]["bn"].running_mean.fill_(math.nan)
    yield "small views of 20 MiB, wrong in the end", saved(stripped(whole)), "numbers that are not finite"


LAUGHS = get(12)
"""A billion of them, after UNUSED_LAUGHS: a dict with a list of tuples of tuples."""
UNUSED_LAUGHS = mapping({
    "unused": EMPTY_LIST
    + (asm.EMPTY_TUPLE + put(0) + APPEND)
    + b"".join(MARK + get(level) * 50 + asm.TUPLE + put(level + 1) + APPEND for level in range(12))
})  # fmt: skip


def laughing(value: bytes) -> bytes:
    """A checkpoint whose model is `value`, which has LAUGHS in it."""
    return archive(UNUSED_LAUGHS + text("model") + value + SETITEM)


def nested_modules(depth: int) -> bytes:
    tree = instance("models.common", "Conv", {})
    for _ in range(depth):
        tree = instance("models.common", "Conv", {"_modules": mapping({"m": tree})})
    return archive(mapping({"model": tree}))


def all_in_all_modules(levels: int) -> bytes:
    """Each module contains the one before it twice: 2 ** levels paths."""
    tree = instance("models.common", "Conv", {}) + put(0)
    for level in range(levels):
        twice = mapping({"a": get(level), "b": get(level)})
        tree += instance("models.common", "Conv", {"_modules": twice}) + put(level + 1)
    return archive(mapping({"unused": EMPTY_LIST + MARK + tree + b"e", "model": get(levels)}))
