"""Checkpoints whose pickle costs memory or time: bombs, and impossible tensors."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping

from support import pickle_assembler as asm
from support.checkpoint_builder import in_one_storage, layers_of, official_model, saved, stripped
from support.hostile_gadgets import FOREIGN, SHELL
from support.pickle_assembler import (
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
    text,
)


def float_number(value: float) -> bytes:
    return b"G" + struct.pack(">d", value)


def laughing(value: Callable[[bytes], bytes]) -> bytes:
    """A checkpoint with a billion laughs where `value` puts them; the tuples lie in an unused list before."""
    levels = [asm.EMPTY_TUPLE + put(0)]
    levels += [asm.MARK + get(level) * 50 + asm.TUPLE + put(level + 1) for level in range(12)]
    unused = asm.EMPTY_LIST + b"".join(level + asm.APPEND for level in levels)
    return archive(mapping({"unused": unused}) + value(get(12)))


def storage_called(key: bytes) -> bytes:
    return items(text("storage"), name("torch", "FloatStorage"), key, text("cpu"), number(4)) + asm.PERSID


def doubled(times: int) -> bytes:
    encoded = call(name("_codecs", "encode"), text("x" * 200), text("latin1"))
    for _ in range(times):
        encoded = call(name("_codecs", "encode"), encoded, text("hex"))
    return archive(mapping({"model": encoded}))


def many(item: bytes, count: int) -> bytes:
    """A list of `count` times `item`, after a list of 10,000 texts of two letters, number 1 in the memo."""
    long_list = (
        asm.EMPTY_LIST
        + put(1)
        + asm.MARK
        + b"".join(text(f"{chr(1000 + index)}x") for index in range(10_000))
        + b"e"
    )
    return archive(asm.EMPTY_LIST + long_list + asm.APPEND + asm.MARK + item * count + b"e")


def nested_modules(depth: int) -> bytes:
    tree = instance("models.common", "Conv", {})
    for _ in range(depth):
        tree = instance("models.common", "Conv", {"_modules": mapping({"m": tree})})
    return archive(mapping({"model": tree}))


def self_containing() -> bytes:
    inside = name("models.yolo", "Model") + asm.EMPTY_TUPLE + asm.NEWOBJ + put(7)
    return archive(mapping({"model": inside + mapping({"_modules": mapping({"m": get(7)})}) + asm.BUILD}))


def all_in_all_modules(levels: int) -> bytes:
    """Each module contains the one before it twice: 2 ** levels paths."""
    tree = instance("models.common", "Conv", {}) + put(0)
    for level in range(levels):
        twice = mapping({"a": get(level), "b": get(level)})
        tree += instance("models.common", "Conv", {"_modules": twice}) + put(level + 1)
    unused = asm.EMPTY_LIST + asm.MARK + tree + b"e"
    return archive(mapping({"unused": unused, "model": get(levels)}))


def small_views(storage_bytes: int) -> bytes:
    """A model whose tensors are parts of one storage; only when all are read a number is found wrong."""
    model = in_one_storage(official_model(), spare=storage_bytes // 2)
    vars(layers_of(model)["0"])["_modules"]["bn"].running_mean.fill_(math.nan)
    return saved(stripped(model))


BOMBS: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "billion laughs as a key": (lambda: laughing(lambda laughs: laughs + b"Ns"), "keys that are neither"),
    "billion laughs as an item of a set": (
        lambda: laughing(
            lambda laughs: (
                text("model")
                + call(name("__builtin__", "set"), asm.EMPTY_LIST + laughs + asm.APPEND)
                + asm.SETITEM
            )
        ),
        "calls '__builtin__.set'",
    ),
    "billion laughs as the model": (
        lambda: laughing(lambda laughs: text("model") + laughs + asm.SETITEM),
        "expected a YOLOv5 model",
    ),
    "billion laughs as the storage": (
        lambda: laughing(lambda laughs: text("model") + storage_called(laughs) + asm.SETITEM),
        "refers to a storage",
    ),
    "a text of two megabytes, encoded often": (
        lambda: archive(
            asm.EMPTY_LIST
            + (name("_codecs", "encode") + put(0) + asm.APPEND)
            + (items(text("x" * 2_000_000), text("latin1")) + put(1) + asm.APPEND)
            + (get(0) + get(1) + asm.REDUCE + asm.APPEND) * 90_000
        ),
        "encodes more than 4194304 bytes",
    ),
    "a dict of numbers that have one hash": (
        lambda: archive(
            asm.EMPTY_DICT
            + asm.MARK
            + b"".join(number(index * (2**61 - 1)) + text("") for index in range(40_000))
            + b"u"
        ),
        "keys that are neither text nor numbers of 64 bits",
    ),
    "a text doubled 40 times": (lambda: doubled(40), "calls '_codecs.encode'"),
    "billion laughs as an item of a set in protocol 4": (
        lambda: laughing(
            lambda laughs: text("model") + asm.EMPTY_SET + asm.MARK + laughs + asm.ADDITEMS + asm.SETITEM
        ),
        "has a set of more than 64 items, or of others",
    ),
    "a set of 65 items": (
        lambda: archive(asm.EMPTY_SET + asm.MARK + b"".join(map(number, range(65))) + asm.ADDITEMS),
        "has a set of more than 64 items",
    ),
    "an item added to a list": (
        lambda: archive(asm.EMPTY_LIST + asm.MARK + number(1) + asm.ADDITEMS),
        "changes a list",
    ),
    "an item added to a model": (
        lambda: archive(instance("models.yolo", "Model", {}) + asm.MARK + number(1) + asm.ADDITEMS),
        "changes a models.yolo.Model",
    ),
    "items without a mark": (lambda: archive(asm.EMPTY_SET + asm.ADDITEMS), "is damaged"),
    "bytes as a key": (
        lambda: archive(asm.EMPTY_DICT + asm.short_bytes(b"model") + number(1) + asm.SETITEM),
        "keys that are neither",
    ),
    "an array of 16 EiB": (
        lambda: archive(asm.byte_array(b"abc", claimed=(1 << 64) - 1), start=asm.START_5),
        "cut short",
    ),
    "an array of 1 GiB": (
        lambda: archive(asm.byte_array(b"abc", claimed=1 << 30), start=asm.START_5),
        "cut short",
    ),
    "an array in the place of the checkpoint": (
        lambda: archive(asm.byte_array(bytes(1000)), start=asm.START_5),
        "expected a dict with the entry 'model', found a bytearray",
    ),
    "bytes in the place of the checkpoint": (
        lambda: archive(asm.short_bytes(b"model"), start=asm.START_4),
        "expected a dict with the entry 'model', found a bytes",
    ),
    "bytes cut short": (lambda: archive(b"B\xff\xff\xff\x7fabc", start=asm.START_4), "cut short"),
    "a short text that is cut short": (lambda: archive(b"\x8c\xffabc", start=asm.START_4), "cut short"),
    "a short text that is not UTF-8": (
        lambda: archive(b"\x8c\x02\xff\xff", start=asm.START_4),
        "contains an invalid string",
    ),
    "a text of 16 EiB": (
        lambda: archive(b"\x8d" + b"\xff" * 8 + b"abc", start=asm.START_4),
        "uses BINUNICODE8",
    ),
    "bytes of 16 EiB": (
        lambda: archive(b"\x8e" + b"\xff" * 8 + b"abc", start=asm.START_4),
        "uses BINBYTES8",
    ),
    "a frame of 16 EiB": (
        lambda: archive(asm.frame(mapping({}), claimed=(1 << 64) - 1), start=asm.START_4),
        "cut short",
    ),
    "a frame behind the end": (
        lambda: archive(asm.frame(mapping({}), claimed=100), start=asm.START_4),
        "cut short",
    ),
    "a frame in a frame": (
        lambda: archive(asm.frame(asm.frame(mapping({})) + mapping({})), start=asm.START_4),
        "cannot be read",
    ),
    "a frame that ends within a text": (
        lambda: archive(asm.frame(text("models"), claimed=8), start=asm.START_4),
        "cannot be read",
    ),
    "a memo of nothing": (lambda: archive(asm.MEMOIZE, start=asm.START_4), "is damaged"),
    "a name of a million characters, often": (
        lambda: archive(
            asm.EMPTY_LIST
            + put(0)
            + (text("models." + "x" * 1_000_000) + put(1) + asm.APPEND)
            + (text("y" * 1_000_000) + put(2) + asm.APPEND)
            + (get(1) + get(2) + asm.STACK_GLOBAL + asm.APPEND) * 100_000
        ),
        "a name of more than 500 characters",
    ),
    "a name of 490 characters, often": (
        lambda: archive(
            asm.EMPTY_LIST
            + (text("models." + "x" * 240) + put(1) + asm.APPEND)
            + (text("y" * 240) + put(2) + asm.APPEND)
            + (asm.MARK + (get(1) + get(2) + asm.STACK_GLOBAL) * 300_000 + b"e")
        ),
        "expected a dict with the entry 'model'",
    ),
    "names without end": (
        lambda: archive(
            asm.EMPTY_LIST
            + asm.MARK
            + b"".join(name("models", f"{index:x}") for index in range(100_000))
            + b"e"
        ),
        "names more than 1000 classes",
    ),
    "a set made of a long list, often": (
        lambda: many(call(name("__builtin__", "set"), get(1)), 20_000),
        "calls '__builtin__.set'",
    ),
    "a dict made of a long list, often": (
        lambda: many(call(name("collections", "OrderedDict"), get(1)), 20_000),
        "calls 'collections.OrderedDict'",
    ),
    "a million lists": (lambda: archive(asm.EMPTY_LIST * 1_100_000), "more than 1000000 operations"),
    "a million sets": (lambda: archive(asm.EMPTY_SET * 990_000), "creates more than 100000 objects"),
    "a memo of a million entries": (
        lambda: archive(asm.EMPTY_LIST + asm.MEMOIZE * 990_000, start=asm.START_4),
        "refers to more than 500000 of its values",
    ),
    "too many objects": (
        lambda: archive(
            asm.EMPTY_LIST
            + name("models.common", "Conv")
            + put(0)
            + b"a"
            + asm.MARK
            + (get(0) + asm.EMPTY_TUPLE + asm.NEWOBJ) * 110_000
            + b"e"
        ),
        "more than 100000 objects",
    ),
    "lists, 20,000 deep": (
        lambda: archive(asm.EMPTY_LIST * 20_000 + asm.APPEND * 19_999),
        "expected a dict with the entry 'model'",
    ),
    "tuples, 20,000 deep": (lambda: archive(asm.EMPTY_TUPLE + b"\x85" * 20_000), "expected a dict"),
    "modules, 1,000 deep": (lambda: nested_modules(1_000), "contains itself"),
    "a module that contains itself": (self_containing, "contains itself"),
    "2 ** 60 modules": (lambda: all_in_all_modules(60), "more than 10000 modules"),
    "a number of 2,000 bits": (
        lambda: archive(mapping({"model": number(1 << 2000)})),
        "expected a YOLOv5 model",
    ),
    "a pickle of 5 MB": (lambda: archive(text("x" * 5_000_000)), "at most 4194304 bytes are read"),
    "a pickle without an end": (lambda: archive(b"(" * 1000), "is damaged"),
    "a pickle cut short": (lambda: archive(b"X\xff\xff\xff\x7fabc"), "cut short"),
    "an empty pickle": (lambda: archive(b"", start=b""), "damaged"),
    "a name with an escape": (lambda: archive(name("models.y\\x6flo", "Model")), FOREIGN),
    "a name that is not UTF-8": (lambda: archive(b"cmodels.\xff\nModel\n"), "contains an invalid string"),
    "a string that is not UTF-8": (
        lambda: archive(b"X\x02\x00\x00\x00\xff\xff"),
        "contains an invalid string",
    ),
    "a memo that was never written": (lambda: archive(get(5)), "damaged"),
    "an item set in a set": (
        lambda: archive(call(name("__builtin__", "set"), asm.EMPTY_LIST) + text("a") + text("b") + b"s"),
        "changes a set",
    ),
    "an item set in a tensor": (
        lambda: archive(asm.tensor() + number(0) + number(9) + b"s"),
        "changes a tensor",
    ),
    "a tensor that is built again": (
        lambda: archive(asm.tensor() + items(number(1), number(2)) + asm.BUILD),
        "changes a tensor",
    ),
    "a text that is called": (lambda: archive(text("os.system") + items(SHELL) + b"R"), "calls something"),
    "a dict whose methods are hidden": (
        lambda: archive(
            mapping(
                {
                    "model": instance(
                        "models.yolo",
                        "Model",
                        {
                            "_modules": call(name("collections", "OrderedDict"))
                            + mapping({"items": number(5)})
                            + asm.BUILD,
                        },
                    )
                }
            )
        ),
        "without layers",
    ),
    "a class in the place of a module": (
        lambda: archive(
            mapping(
                {
                    "model": instance(
                        "models.yolo",
                        "Model",
                        {
                            "_modules": mapping({"model": name("models.yolo", "Detect")}),
                        },
                    )
                }
            )
        ),
        "expected modules below",
    ),
    "a class in the place of the checkpoint": (
        lambda: archive(name("models.yolo", "Detect")),
        "expected a dict with the entry 'model'",
    ),
    "a function in the place of a class": (
        lambda: archive(name("torch._utils", "_rebuild_tensor_v2") + items() + b"\x81"),
        "creates a 'torch._utils._rebuild_tensor_v2'",
    ),
    "a memo entry number of 4 billion": (
        lambda: archive(mapping({"model": text("x") + put(2**32 - 1)})),
        "expected a YOLOv5 model",
    ),
    "an item without a value": (
        lambda: archive(asm.EMPTY_DICT + asm.MARK + text("a") + b"u"),
        "cannot be read",
    ),
    "a new dict of a class": (
        lambda: archive(name("collections", "OrderedDict") + asm.EMPTY_TUPLE + b"\x81"),
        "creates a 'collections.OrderedDict'",
    ),
}
TENSORS: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "4 Ti numbers in 16 bytes": (lambda: archive(model(asm.tensor((1 << 42,)))), "tensors claim"),
    "1 Gi numbers in 16 bytes": (lambda: archive(model(asm.tensor((1 << 30,)))), "tensors claim"),
    "more numbers than fit a size": (
        lambda: archive(model(asm.tensor((1 << 62, 1 << 62), (1, 1)))),
        "cannot be read",
    ),
    "stride 0": (lambda: archive(model(asm.tensor((1 << 40,), (0,)))), "has the strides"),
    "negative stride": (lambda: archive(model(asm.tensor((4,), (-1,)))), "cannot be read"),
    "a size that no number of bytes has": (
        lambda: archive(model(asm.tensor((0, 1 << 61, 1 << 61), (1, 1, 1)))),
        "a tensor has the shape",
    ),
    "negative size": (lambda: archive(model(asm.tensor((-4,)))), "cannot be read"),
    "a size that is a text": (
        lambda: archive(model(call(name("torch._utils", "_rebuild_tensor_v2"), text("x")))),
        "cannot be read",
    ),
    "a storage of 1 Ti numbers": (
        lambda: archive(model(asm.tensor(stored=asm.storage(1 << 40)))),
        "claims 4398046511104 bytes, but has 16",
    ),
    "a storage of no numbers": (lambda: archive(model(asm.tensor(stored=asm.storage(0)))), "number 3 of 0"),
    "a storage of fewer numbers than it has": (
        lambda: archive(model(asm.tensor((2,), stored=asm.storage(2)))),
        "claims 8 bytes, but has 16",
    ),
    "a storage of half a number": (
        lambda: archive(mapping({"model": call(name("torch._utils", "_rebuild_tensor_v2"), items(
            text("storage"), name("torch", "FloatStorage"), text("0"), text("cpu"), float_number(0.5)
        ) + asm.PERSID)})),
        "a tensor has the size 0.5",
    ),
    "an offset behind the end": (
        lambda: archive(model(call(name("torch._utils", "_rebuild_tensor_v2"), asm.storage(),
                                   number(4), items(number(1)), items(number(1))))),
        "number 4 of 4",
    ),
    "an offset before the beginning": (
        lambda: archive(model(call(name("torch._utils", "_rebuild_tensor_v2"), asm.storage(),
                                   number(-1), items(number(1)), items(number(1))))),
        "a tensor has the size -1",
    ),
    "more strides than sizes": (lambda: archive(model(asm.tensor((4,), (1, 1)))), "has the strides [1, 1]"),
    "17 dimensions": (lambda: archive(model(asm.tensor((1,) * 17, (1,) * 17))), "has the strides"),
    "a tensor of a list in place of a storage": (
        lambda: archive(model(asm.tensor(stored=asm.EMPTY_LIST))),
        "cannot be read",
    ),
    "66 MiB that no layer uses": (
        lambda: archive(model(asm.tensor()), storages=(bytes(16), bytes(66 << 20))),
        "bytes that belong to no layer",
    ),
    "a storage that is not there": (
        lambda: archive(model(asm.tensor(stored=asm.storage(key="../../version")))),
        "the storage '../../version' is missing",
    ),
    "tensors that share one storage": (
        lambda: archive(
            mapping({"model": instance("models.yolo", "Model", {"_parameters": mapping({
                f"weight{index}": asm.tensor((1 << 20,), stored=asm.storage(1 << 20)) for index in range(50)
            })})}),
            storages=[bytes(4 << 20)],
        ),
        "tensors claim",
    ),
    "small views of 20 MiB": (lambda: small_views(20 << 20), "numbers that are not finite"),
    "bytes as weights": (
        lambda: archive(model(asm.tensor(stored=asm.storage(16, kind="ByteStorage")))),
        "holds torch.uint8",
    ),
    "complex weights": (
        lambda: archive(model(asm.tensor(stored=asm.storage(2, kind="ComplexFloatStorage")))),
        "'torch.ComplexFloatStorage'",
    ),
    "a parameter that is a text": (lambda: archive(model(text("x"))), "expected tensors"),
    "parameters that are a list": (
        lambda: archive(mapping({"model": instance("models.yolo", "Model", {"_parameters": b"]"})})),
        "expected a dict as _parameters",
    ),
    "modules that are texts": (
        lambda: archive(
            mapping({"model": instance("models.yolo", "Model", {"_modules": mapping({"model": text("x")})})})
        ),
        "expected modules",
    ),
}  # fmt: skip
