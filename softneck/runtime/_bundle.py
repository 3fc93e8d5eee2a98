"""Bundles: one self-contained source text of a kind's runtime module and all runtime modules that it imports.

A runtime module imports numpy, math and other runtime modules only. The bundle holds the functions that it needs of
those modules, one after the other, without comments and with indices in place of names (see `_names`). numba compiles
it, and an FMU contains it: softneck and the FMU's host run the same text. Its module name is a hash of the content, so
    a changed line only affects the kinds that use it.

A runtime may contain others: `outer(inner:11,other:13)` is module `outer` with member `inner`, which reads the first
11 arrays after those of `outer`, and member `other`, which reads the next 13. Each member's names get a prefix, and the
calls `member_*` of `_members_runtime` become calls of the members. If the outer module calls `member_tangent`, the
derivatives of the members are added.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from softneck.core import SettingsError

from ._layout import Arrays, StateVector
from ._names import lower, state_size
from ._own import PREFIX, own_text
from ._tangent import with_tangent
from ._unrolled import unroll

# Set by the code that compiles the bundle; shared by all members (see `_compiled_runtime`).
_SHARED = {"COMPILED"}
_CALLS = {
    "member_size": ("", "state_size", True),
    "member_initialise": (", parameters, state, outputs", "initialise", False),
    "member_step": (", parameters, state, inputs, outputs", "step", False),
}
_ROW_ARGUMENTS = "state_rows, inputs_rows, outputs_rows, moved"
_TANGENT = {"member_tangent": (f", parameters, state, inputs, outputs, {_ROW_ARGUMENTS}", "step_tangent", False)}


def add_prefix(text: str, prefix: str) -> str:
    """Return a bundle without its imports, with `prefix` before every name that it defines."""
    tree = ast.parse(text)
    body = [node for node in tree.body if not isinstance(node, ast.Import | ast.ImportFrom)]
    names = {node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for node in body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        names |= {target.id for target in targets if isinstance(target, ast.Name)}
    tree.body = body
    return ast.unparse(_Prefix(names - _SHARED, prefix).visit(tree)) + "\n\n"


def member_calls(counts: list[int], own: int, *, texts: list[int] | None = None, tangents: bool = False) -> str:
    """Return the source of the functions of `_members_runtime` for members with these numbers of arrays.

    Args:
        counts: arrays of each member.
        own: number of arrays before those of the members.
        texts: index of the source text that each member runs; None gives each its own.
        tangents: the members have a function `step_tangent`.
    """
    lines = ["", "def member_count():", f"    return {len(counts)}", ""]
    for call, (arguments, name, returns) in (_CALLS | (_TANGENT if tangents else {})).items():
        lines += ["", f"def {call}(arrays, member{arguments}):"]
        start = own
        for member, count in enumerate(counts):
            # Constant bounds: the compiler then knows the type of each array.
            part = f"arrays[{start}:{start + count}]"
            result = "return " if returns else ""
            text = member if texts is None else texts[member]
            lines += [f"    if member == {member}:", f"        {result}m{text}_{name}({part}{arguments})"]
            start += count
        lines += ["    return 0" if returns else "    return None", ""]
    return "\n".join(lines) + "\n"


class _Prefix(ast.NodeTransformer):
    def __init__(self, names: set[str], prefix: str) -> None:
        self._names, self._prefix = names, prefix

    def visit_Name(self, node: ast.Name) -> ast.Name:
        """Rename a use; local variables of the same name are renamed alike."""
        return ast.copy_location(ast.Name(self._new(node.id), node.ctx), node)

    def visit_arg(self, node: ast.arg) -> ast.arg:
        """Rename a parameter with the name of a function."""
        node.arg = self._new(node.arg)
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        """Rename a function; its docstring is left out."""
        node.name = self._new(node.name)
        if ast.get_docstring(node) is not None and len(node.body) > 1:
            node.body = node.body[1:]
        self.generic_visit(node)
        return node

    def _new(self, name: str) -> str:
        return self._prefix + name if name in self._names else name


_LOOPS_MODULE = "softneck.runtime._loops_runtime"
_MEMBERS_MODULE = "softneck.runtime._members_runtime"
_LAYOUT_MODULE = "softneck.runtime._layout"
# Motors and outputs for which a text is written if the runtime's name does not give others: those of the neck.
_DEFAULT_SIZES = (3, 2)
# `module@n` reads its sizes from its arrays: one text for all robots, as in the compiled library.
ANY_SIZE = "n"
_ALLOWED = {"numpy", "math", "__future__", _LAYOUT_MODULE}


@dataclass(frozen=True, slots=True)
class _Piece:
    """A function or a constant: the names that it defines, the names that it reads, and its text."""

    names: frozenset[str]
    reads: frozenset[str]
    text: str


@cache
def bundle(runtime: str, *, loops: bool = True, skip: tuple[str, ...] = (), linked: bool = False) -> str:
    """Return the source text of runtime module `runtime` with all functions and constants that it uses.

    Args:
        runtime: dotted name, with members in brackets.
        loops: add the loops over `step`; false for a module of plain functions.
        skip: functions to leave out because the caller supplies them.
        linked: call the members' functions that are compiled already (see `load_runtime`) instead of including their
            text; derivatives always include it.

    Raises:
        SettingsError: a module has a forbidden import, or two modules define the same name.
    """
    outer, members = _members(runtime)
    outer, sizes = _sizes(outer)
    if outer.startswith(PREFIX):
        loop = [piece.text for piece in _pieces(_LOOPS_MODULE, sizes) if loops and "step" not in piece.names]
        return "\n".join(["import numpy as np", own_text(outer), *loop])
    order: list[str] = []
    _collect(outer, order)
    tangents = any(_asks_for_tangents(module) for module in order)
    # Members with the same runtime share one text, which is then compiled once.
    names = [member for member, _ in members]
    homes = [names.index(name) for name in names]
    plain = {i: bundle(names[i], loops=False) for i in dict.fromkeys(homes)}
    if linked and not tangents:
        texts = [_link(names[i], content_name(text), f"m{i}_") for i, text in plain.items()]
    else:
        texts = [add_prefix(with_tangent(text) if tangents else text, f"m{i}_") for i, text in plain.items()]
    if members and _MEMBERS_MODULE in order:
        order.remove(_MEMBERS_MODULE)
        texts.append(member_calls([count for _, count in members], own_arrays(outer), texts=homes, tangents=tangents))
    found = {module: [piece for piece in _pieces(module, sizes) if not set(skip) & piece.names] for module in order}
    home = next((module for module in order if _defines(found[module], "step")), None)
    if home is not None and not any(_defines(pieces, "state_size") for pieces in found.values()):
        found[home].append(_piece(state_size(layout_of(home, Arrays), layout_of(home, StateVector), dict(sizes))))
    if loops:
        found[_LOOPS_MODULE] = [piece for piece in _pieces(_LOOPS_MODULE, sizes) if "step" not in piece.names]
    _check_names(found)
    kept = _reachable_names(found, outer, {name for text in texts for name in _read(ast.parse(text))})
    parts = ["# A softneck runtime: generated, do not edit.", "import math", "", "import numpy as np", "", *texts]
    parts += [piece.text for pieces in found.values() for piece in pieces if kept & piece.names]
    return "\n".join(parts)


def content_name(text: str, prefix: str = "softneck") -> str:
    """Return a module name with a hash of `text`."""
    return f"{prefix}_{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def _link(runtime: str, content: str, prefix: str) -> str:
    """Return lines that import a member's functions from its own module; they contain the hash of its text."""
    functions = {"state_size": "linked_size", "initialise": "initialise", "step": "step"}
    lines = [f'{prefix}linked = load_runtime("{runtime}")', f'{prefix}content = "{content}"']
    lines += [f"{prefix}{name} = {prefix}linked.{field}" for name, field in functions.items()]
    return "\n".join(["from softneck.runtime import load_runtime", "", *lines, f"del load_runtime, {prefix}linked", ""])


def sized_name(runtime: str, motors: int, outputs: int) -> str:
    """Return the name of a runtime for this number of motors and outputs; for the neck's, the name as it is."""
    return runtime if (motors, outputs) == _DEFAULT_SIZES else f"{runtime}@{motors}x{outputs}"


def _sizes(outer: str) -> tuple[str, tuple[tuple[str, int], ...]]:
    """Return the module in a runtime's name, with its numbers of motors and outputs; empty if read from arrays."""
    module, _, size = outer.partition("@")
    if size == ANY_SIZE:
        return module, ()
    motors, outputs = map(int, size.split("x")) if size else _DEFAULT_SIZES
    return module, (("motors", motors), ("outputs", outputs))


def own_arrays(outer: str) -> int:
    """Return the number of arrays that a module with members reads itself, before those of its members."""
    return len(layout_of(outer, Arrays).fields)


def layout_of(module: str, base: type) -> Any:
    """Return the subclass of `base` that annotates an argument of a module's `step`, or else of its first function.

    Raises SettingsError: no argument has such an annotation.
    """
    module = module.partition("@")[0]
    functions = [node for node in _tree(module).body if isinstance(node, ast.FunctionDef)]
    for function in sorted(functions, key=lambda node: node.name != "step"):
        for argument in function.args.args:
            name = argument.annotation.id if isinstance(argument.annotation, ast.Name) else ""
            found = getattr(import_module(module), name, None)
            if isinstance(found, type) and issubclass(found, base):
                return found
    raise SettingsError(f"runtime module {module} does not declare its {base.__name__}.")


def _members(runtime: str) -> tuple[str, list[tuple[str, int]]]:
    """Return the outer module, and each member with the number of its arrays."""
    outer, _, inner = runtime.partition("(")
    pairs = [part.rpartition(":") for part in split_members(inner[:-1])] if inner else []
    return outer, [(name, int(count)) for name, _, count in pairs]


def split_members(inner: str) -> list[str]:
    """Split at the commas outside brackets: members may have members of their own."""
    parts, depth, start = [], 0, 0
    for i, letter in enumerate(inner):
        depth += {"(": 1, ")": -1}.get(letter, 0)
        if letter == "," and depth == 0:
            parts.append(inner[start:i])
            start = i + 1
    return [*parts, inner[start:]]


def _asks_for_tangents(module: str) -> bool:
    """Return whether a module uses the derivatives of its members."""
    imports = [
        node for node in _tree(module).body if isinstance(node, ast.ImportFrom) and node.module == _MEMBERS_MODULE
    ]
    return any(alias.name == "member_tangent" for node in imports for alias in node.names)


def _collect(module: str, order: list[str]) -> None:
    for node in _tree(module).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").endswith("_runtime"):
            _collect(node.module or "", order)
    if module not in order:
        order.append(module)


@cache
def _pieces(module: str, sizes: tuple[tuple[str, int], ...]) -> tuple[_Piece, ...]:
    """Return the functions and constants of a module, with indices in place of names, for a robot of these sizes."""

    def find(name: str) -> Any:
        return None if hasattr(builtins, name) else getattr(import_module(module), name, None)

    kept: list[_Piece] = []
    for statement in ast.parse(_source(module)).body:  # a new tree, as `lower` modifies it
        node = unroll(statement, dict(sizes))
        if isinstance(node, ast.Import | ast.ImportFrom):
            _check_import(module, node)
        elif isinstance(node, ast.FunctionDef):
            kept.append(_piece(lower(node, find, module, dict(sizes))))
        elif isinstance(node, ast.Assign):
            kept.append(_piece(node))
        elif not isinstance(node, ast.ClassDef | ast.Expr):
            raise SettingsError(f"runtime module {module} has a statement of another kind in line {node.lineno}.")
    return tuple(kept)


def _piece(node: ast.FunctionDef | ast.Assign) -> _Piece:
    if isinstance(node, ast.FunctionDef):
        names = {node.name}
    else:
        names = {part.id for target in node.targets for part in ast.walk(target) if isinstance(part, ast.Name)}
    return _Piece(frozenset(names), frozenset(_read(node)), ast.unparse(node) + "\n")


def _read(node: ast.AST) -> set[str]:
    return {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}


def _defines(pieces: list[_Piece], name: str) -> bool:
    return any(name in piece.names for piece in pieces)


def _check_names(found: dict[str, list[_Piece]]) -> None:
    names: dict[str, str] = {}
    for module, pieces in found.items():
        for defined in sorted(name for piece in pieces for name in piece.names):
            if defined in names:
                raise SettingsError(f"runtime modules {names[defined]} and {module} both define `{defined}`.")
            names[defined] = module


def _reachable_names(found: dict[str, list[_Piece]], outer: str, others: set[str]) -> set[str]:
    """Return the names that the outer module defines or imports, and all that these, the loops and `others` use."""
    reads = {name: piece.reads for pieces in found.values() for piece in pieces for name in piece.names}
    imported = [item for node in _tree(outer).body if isinstance(node, ast.ImportFrom) for item in node.names]
    waiting = ["state_size", *others, *(item.asname or item.name for item in imported)]
    waiting += [name for module in (outer, _LOOPS_MODULE) for piece in found.get(module, ()) for name in piece.names]
    kept: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in reads and name not in kept:
            kept.add(name)
            waiting += reads[name]
    return kept


def _check_import(module: str, node: ast.Import | ast.ImportFrom) -> None:
    imported = [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
    for name in imported:
        # Only absolute imports of runtime modules; kinds of other packages may share text in the same way.
        runtime = name.endswith("_runtime") and not (isinstance(node, ast.ImportFrom) and node.level)
        if not runtime and name not in _ALLOWED:
            raise SettingsError(f"runtime module {module} imports `{name}`; only numpy and math are allowed.")


@cache
def _source(module: str) -> str:
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        raise SettingsError(f"there is no runtime module `{module}`.")
    return Path(spec.origin).read_text(encoding="utf-8")


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(_source(module))
