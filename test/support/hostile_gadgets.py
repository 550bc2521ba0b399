"""Checkpoints whose pickle calls what no checkpoint needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from support import pickle_assembler as asm
from support.pickle_assembler import (
    archive,
    call,
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
    "protocol 4": (
        lambda: archive(text("os") + text("system") + b"\x93" + items(SHELL) + asm.REDUCE, start=b"\x80\x04"),
        "protocol",
    ),
    "a name made of texts": (lambda: archive(text("os") + text("system") + b"\x93"), "STACK_GLOBAL"),
    "INST of Python 1": (lambda: archive(b"(" + SHELL + b"ios\nsystem\n"), "INST"),
    "extension code": (lambda: archive(b"\x82\x01"), "EXT1"),
    "persistent text": (lambda: archive(b"Pos.system\n"), "PERSID"),
}
