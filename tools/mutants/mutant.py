"""Mutants of a module: its code with one small change each, made by the operators of mutmut.

Annotations, docstrings, texts for people and what only tools read are left alone, as no test should notice.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from hashlib import sha256
from itertools import islice
from typing import TypeAlias

import libcst as cst
from libcst.metadata import MetadataWrapper, PositionProvider
from mutmut.mutation.mutators import mutation_operators, operator_string

from tools.mutants.folders import PACKAGE, REPOSITORY

TOLD_TO_PEOPLE = frozenset({"debug", "info", "warning", "warn", "error", "exception"})
"""Functions and methods that write a log entry or a warning."""
READ_BY_TOOLS = frozenset({"cast", "TypeVar", "NewType", "ParamSpec", "isinstance", "overload"})
WITHOUT_EFFECT = frozenset({"strict", "stacklevel", "description"})
"""Keyword arguments: checks of the programmer, and texts."""
_ALIAS = re.compile(r"[A-Z][a-z]\w*")
_ALIAS_VALUES = (cst.Subscript, cst.BinaryOperation)


@dataclass(frozen=True)
class Mutant:
    """`module`: its path in the package; `scope`: `Class.method` or empty; `tree`: the unchanged module.

    `first_line` and `last_line` are those of the outermost function around the change, or 0.
    """

    module: str
    scope: str
    before: str
    after: str
    number: int
    first_line: int
    last_line: int
    tree: cst.Module = field(repr=False, compare=False)
    node: cst.CSTNode = field(repr=False, compare=False)
    changed: cst.CSTNode = field(repr=False, compare=False)

    @property
    def name(self) -> str:
        """Stays the same while other lines change; `number` tells equal changes of a scope apart."""
        place = f"{self.module} {self.scope}".strip()
        return f"{place}: {self.before} => {self.after}" + (f" ({self.number})" if self.number > 1 else "")

    def code(self) -> str:
        """The changed module."""
        return str(self.tree.deep_replace(self.node, self.changed).code)

    def is_python(self) -> bool:
        """Whether the changed module can be compiled."""
        try:
            compile(self.code(), self.module, "exec", dont_inherit=True)
        except SyntaxError:
            return False
        return True


def mutants_of(folder: str) -> list[Mutant]:
    """Every mutant of the modules in `folder` of the package, in the order of the code."""
    modules = sorted((REPOSITORY / PACKAGE / folder).glob("*.py"))
    return [
        mutant for module in modules for mutant in mutants_in(f"{folder}/{module.name}", module.read_text())
    ]


def sampled(mutants: Iterable[Mutant], count: int, seed: int) -> list[Mutant]:
    """`count` of `mutants`, the same ones while their names stay: other code of a folder may change."""
    ordered = sorted(mutants, key=lambda mutant: sha256(f"{seed} {mutant.name}".encode()).digest())
    return list(islice((mutant for mutant in ordered if mutant.is_python()), count))


def mutants_in(module: str, code: str) -> Iterator[Mutant]:
    """Every mutant of `code`, in its order."""
    wrapper = MetadataWrapper(cst.parse_module(code))
    visitor = _Changes()
    wrapper.visit(visitor)
    seen = Counter[tuple[str, str, str]]()
    for node, changed, scope, lines in visitor.found:
        key = (scope, _in_one_line(node), _in_one_line(changed))
        seen[key] += 1
        yield Mutant(module, *key, seen[key], *lines, wrapper.module, node, changed)


def _in_one_line(node: cst.CSTNode) -> str:
    return " ".join(cst.Module([]).code_for_node(node).split())


_Change: TypeAlias = tuple[cst.CSTNode, cst.CSTNode, str, tuple[int, int]]
"""Node, changed node, scope, and the first and last line of the outermost function, or 0."""


class _Changes(cst.CSTVisitor):
    """Collects the changes of a module."""

    METADATA_DEPENDENCIES = (PositionProvider,)

    def __init__(self) -> None:
        super().__init__()
        self.found: list[_Change] = []
        self._scope: list[str] = []
        self._exempt = set[cst.CSTNode]()
        self._functions: list[tuple[int, int]] = []

    def on_visit(self, node: cst.CSTNode) -> bool:
        if self._is_left_alone(node):
            return False
        if is_reshape(node):
            self._exempt.update(node.args)
        if name := self._named(node):
            self._scope.append(name)
        if isinstance(node, cst.FunctionDef):
            position = self.get_metadata(PositionProvider, node.body)
            self._functions.append((position.start.line, position.end.line))
        lines = self._functions[0] if self._functions else (0, 0)
        self.found += [(node, changed, ".".join(self._scope), lines) for changed in changes(node)]
        return True

    def on_leave(self, original_node: cst.CSTNode) -> None:
        if self._is_left_alone(original_node):
            return
        if isinstance(original_node, cst.FunctionDef):
            self._functions.pop()
        if self._named(original_node):
            self._scope.pop()

    def _is_left_alone(self, node: cst.CSTNode) -> bool:
        return node in self._exempt or is_exempt(node) or (not self._functions and is_alias(node))

    def _named(self, node: cst.CSTNode) -> str:
        """The name of a class or function, or of what is assigned outside of functions."""
        if isinstance(node, cst.FunctionDef | cst.ClassDef):
            return str(node.name.value)
        if self._functions or not isinstance(node, cst.Assign | cst.AnnAssign):
            return ""
        target = node.targets[0].target if isinstance(node, cst.Assign) else node.target
        return str(target.value) if isinstance(target, cst.Name) else ""


def changes(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    """What the operators make of `node`, without what has no effect."""
    if isinstance(node, cst.Assign | cst.AnnAssign) and node.value is not None and is_exempt(node.value):
        return
    for kind, operator in mutation_operators:
        if not isinstance(node, kind):
            continue
        made = list(operator(node))
        if operator is operator_string:
            made = made[:1]  # the others change only upper and lower case
        for changed in made:
            if not _changes_exempt_argument(node, changed):
                yield changed


def is_exempt(node: cst.CSTNode) -> bool:
    """Whether neither `node` nor what is in it is changed."""
    if isinstance(node, cst.Annotation | cst.Decorator | cst.Raise | cst.Assert | cst.FormattedString):
        return True
    if isinstance(node, cst.SimpleString):
        return " " in node.value
    if isinstance(node, cst.Call):
        name = node.func.attr if isinstance(node.func, cst.Attribute) else node.func
        return isinstance(name, cst.Name) and name.value in TOLD_TO_PEOPLE | READ_BY_TOOLS
    if isinstance(node, cst.Arg):
        return node.keyword is not None and node.keyword.value in WITHOUT_EFFECT
    return False


def is_reshape(node: cst.CSTNode) -> bool:
    """Whether `node` is a call such as `rows.reshape(-1, 3)`: numpy takes every negative number for -1."""
    return (
        isinstance(node, cst.Call)
        and isinstance(node.func, cst.Attribute)
        and node.func.attr.value == "reshape"
    )


def is_alias(node: cst.CSTNode) -> bool:
    """Whether `node` only names a type: `Indices = NDArray[np.intp]`."""
    if not isinstance(node, cst.Assign) or not isinstance(node.targets[0].target, cst.Name):
        return False
    name = node.targets[0].target.value
    return name in ("__all__", "__slots__") or (
        _ALIAS.fullmatch(name) is not None and isinstance(node.value, _ALIAS_VALUES)
    )


def _changes_exempt_argument(node: cst.CSTNode, changed: cst.CSTNode) -> bool:
    """Whether an argument that has no effect, or a text, is replaced or removed."""
    if not isinstance(node, cst.Call) or not isinstance(changed, cst.Call):
        return False
    kept = {id(argument) for argument in changed.args}
    return any(
        is_exempt(argument) or is_exempt(argument.value) for argument in node.args if id(argument) not in kept
    )
