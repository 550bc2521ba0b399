"""Checkpoints whose pickle calls what no checkpoint needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from support import pickle_assembler as asm
from support.pickle_assembler import (
    archive,
    call,
    get,
    instance,
    items,
    mapping,
    name,
    number,
    text,
)

MARKER = "hostile_marker"
"""A module that a test puts on the path; importing it leaves a trace."""
FOREIGN = "which no YOLOv5 checkpoint needs: do not trust"


def gadget(module: str, function: str, *arguments: bytes) -> bytes:
    return archive(mapping({"model": call(name(module, function), *arguments)}))


SHELL = text(f"{MARKER}=1; touch {MARKER}")
CODE = text(f"open('{MARKER}', 'w')")
GADGETS: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "os.system": (lambda: gadget("os", "system", SHELL), "'os.system'"),
    "posix.system": (lambda: gadget("posix", "system", SHELL), "'posix.system'"),
    "eval": (lambda: gadget("builtins", "eval", CODE), "'builtins.eval'"),
    "eval of Python 2": (lambda: gadget("__builtin__", "eval", CODE), "'__builtin__.eval'"),
    "exec": (lambda: gadget("builtins", "exec", CODE), "'builtins.exec'"),
    "getattr": (lambda: gadget("builtins", "getattr", name("os", "system"), text("x")), "'os.system'"),
    "getattr of a class that is known": (
        lambda: gadget("builtins", "getattr", name("models.yolo", "Detect"), text("__subclasses__")),
        "calls 'builtins.getattr'",
    ),
    "getattr of an object": (
        lambda: gadget("__builtin__", "getattr", instance("models.common", "Conv", {}), text("__class__")),
        "calls '__builtin__.getattr'",
    ),
    "getattr of another class": (
        lambda: gadget("__builtin__", "getattr", name("models.common", "Conv"), text("forward")),
        "calls '__builtin__.getattr'",
    ),
    "getattr of a text": (
        lambda: gadget("__builtin__", "getattr", text("x"), text("forward_fuse")),
        "calls '__builtin__.getattr'",
    ),
    "getattr of three": (
        lambda: gadget("__builtin__", "getattr", name("models.yolo", "Detect"), text("forward"), text("x")),
        "calls '__builtin__.getattr'",
    ),
    "getattr of nothing": (lambda: gadget("__builtin__", "getattr"), "calls '__builtin__.getattr'"),
    "a method that is called": (
        lambda: archive(
            call(name("__builtin__", "getattr"), name("models.yolo", "Detect"), text("forward"))
            + items()
            + asm.REDUCE
        ),
        "calls 'method'",
    ),
    "something foreign beside DataParallel": (
        lambda: archive(
            asm.EMPTY_LIST
            + name("torch.nn.parallel", "DataParallel")
            + asm.APPEND
            + name("os", "system")
            + asm.APPEND
        ),
        "do not trust",
    ),
    "subprocess": (lambda: gadget("subprocess", "Popen", SHELL), "'subprocess.Popen'"),
    "import of a module": (lambda: gadget(MARKER, "anything"), f"'{MARKER}.anything'"),
    "import by function": (
        lambda: gadget("importlib", "import_module", text(MARKER)),
        "'importlib.import_module'",
    ),
    "run of a module": (lambda: gadget("runpy", "_run_code", CODE), "'runpy._run_code'"),
    "unpickling again": (lambda: gadget("_pickle", "loads", text("x")), "'_pickle.loads'"),
    "numpy.load": (lambda: gadget("numpy", "load", text("/etc/passwd")), "'numpy.load'"),
    "torch.load": (lambda: gadget("torch", "load", text("/etc/passwd")), "'torch.load'"),
    "torch.hub.load": (lambda: gadget("torch.hub", "load", text("evil/repo")), "'torch.hub.load'"),
    "torch tensor of a size": (
        lambda: gadget("torch", "FloatTensor", number(1 << 40)),
        "'torch.FloatTensor'",
    ),
    "bytearray of a size": (lambda: gadget("builtins", "bytearray", number(1 << 34)), "'builtins.bytearray'"),
    "open": (lambda: gadget("io", "open", text(MARKER), text("w")), "'io.open'"),
    "webbrowser": (lambda: gadget("webbrowser", "open", text("http://localhost")), "'webbrowser.open'"),
    "functools.partial": (
        lambda: gadget("functools", "partial", name("os", "system")),
        "'functools.partial'",
    ),
    "our own code": (
        lambda: gadget("yolov5_lifecycle.process.memory", "release_unused_memory"),
        "'yolov5_lifecycle.process.memory.release_unused_memory'",
    ),
    "a name that looks like a layer": (lambda: gadget("models.yolo os", "system", SHELL), FOREIGN),
    "os.system in protocol 4": (
        lambda: archive(asm.stacked_name("os", "system") + items(SHELL) + asm.REDUCE, start=asm.START_4),
        "'os.system'",
    ),
    "os.system in protocol 5, in a frame": (
        lambda: archive(
            asm.frame(asm.stacked_name("os", "system") + items(SHELL) + asm.REDUCE), start=asm.START_5
        ),
        "'os.system'",
    ),
    "protocol 6": (lambda: archive(mapping({}), start=b"\x80\x06"), "of protocol 6, expected 2 to 5"),
    "protocol 1": (lambda: archive(mapping({}), start=b"\x80\x01"), "of protocol 1, expected 2 to 5"),
    "a name made of texts in protocol 2": (
        lambda: archive(text("os") + text("system") + asm.STACK_GLOBAL),
        "'os.system'",
    ),
    "a module from the memo, whose place was counted": (
        lambda: archive(
            asm.EMPTY_LIST
            + asm.MARK
            + (text("models.yolo") + asm.MEMOIZE + text("os") + asm.MEMOIZE)
            + (get(1) + text("system") + asm.STACK_GLOBAL + items(SHELL) + asm.REDUCE)
            + b"e"
        ),
        "'os.system'",
    ),
    "a method by its dotted name": (
        lambda: archive(asm.stacked_name("models.yolo", "Detect.forward.__globals__")),
        "expected a dict with the entry 'model'",
    ),
    "an attribute of what torch has": (
        lambda: archive(asm.stacked_name("torch._utils", "_rebuild_tensor_v2.__globals__")),
        "'torch._utils._rebuild_tensor_v2.__globals__'",
    ),
    "a name of bytes": (
        lambda: archive(asm.short_bytes(b"os") + text("system") + asm.STACK_GLOBAL),
        "a name that is not text",
    ),
    "a name of numbers": (
        lambda: archive(number(1) + number(2) + asm.STACK_GLOBAL),
        "a name that is not text",
    ),
    "a name of nothing": (lambda: archive(asm.STACK_GLOBAL), "is damaged"),
    "a name after another one": (
        lambda: archive(
            asm.stacked_name("models.yolo", "Model") + text("system") + asm.STACK_GLOBAL, start=asm.START_4
        ),
        "a name that is not text",
    ),
    "data outside of the file": (lambda: archive(b"\x97", start=asm.START_5), "NEXT_BUFFER"),
    "data outside of the file, to read only": (
        lambda: archive(asm.byte_array(b"x") + b"\x98", start=asm.START_5),
        "READONLY_BUFFER",
    ),
    "an object with named arguments": (
        lambda: archive(name("models.yolo", "Model") + items() + b"}" + b"\x92", start=asm.START_4),
        "NEWOBJ_EX",
    ),
    "a frozen set": (lambda: archive(asm.MARK + b"\x91", start=asm.START_4), "FROZENSET"),
    "INST of Python 1": (lambda: archive(b"(" + SHELL + b"ios\nsystem\n"), "INST"),
    "extension code": (lambda: archive(b"\x82\x01"), "EXT1"),
    "a model after torch.compile": (
        lambda: archive(
            mapping({"model": name("torch._dynamo.eval_frame", "OptimizedModule")})
            + mapping(
                {"more": name("contextlib", "nullcontext"), "most": name("torch", "_TorchCompileWrapper")}
            )
        ),
        "after torch.compile and names 'torch._dynamo.eval_frame.OptimizedModule', a part of the compiler",
    ),
    "something foreign beside torch.compile": (
        lambda: archive(
            asm.EMPTY_LIST
            + name("torch._dynamo.eval_frame", "OptimizedModule")
            + asm.APPEND
            + name("os", "system")
            + asm.APPEND
        ),
        "do not trust",
    ),
    "persistent text": (lambda: archive(b"Pos.system\n"), "PERSID"),
}
