"""One self-contained source text out of a kind's runtime modules.

A runtime module imports numpy, math and other runtime modules only. The bundle is what its functions need of those
modules, behind each other, without words and with places for names (see `_names`). numba compiles it, and an FMU
carries it: what runs in the kit and what runs in the host is the same text, under a name that its content decides.
A line that changes reaches the kinds that need it and no other.

A runtime may hold others: `outer(inner:11,other:13)` is module `outer` over member `inner`, which reads the first
11 arrays behind those of `outer`, and `other`, which reads the next 13. Each member's names get a prefix, and the
calls `member_*` of `_members_runtime` become calls of the members; one that calls `member_tangent` gets their
derivatives with them.
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
from ._names import lowered, state_size
from ._own import PREFIX, own_text
from ._tangent import with_tangent
from ._unrolled import unrolled

# Set from outside by whoever compiles; one for all (see `_compiled_runtime`).
_SHARED = {"COMPILED"}
_CALLS = {
    "member_size": ("", "state_size", True),
    "member_initialise": (", parameters, state, outputs", "initialise", False),
    "member_step": (", parameters, state, inputs, outputs", "step", False),
}
_ROWS = "state_rows, inputs_rows, outputs_rows, moved"
_TANGENT = {"member_tangent": (f", parameters, state, inputs, outputs, {_ROWS}", "step_tangent", False)}


def prefixed(text: str, prefix: str) -> str:
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
    """Return the functions of `_members_runtime` for members that read so many arrays, behind `own` others.

    Args:
        counts: arrays of each member.
        own: arrays before them.
        texts: number of the text that each runs; None gives each its own.
        tangents: the members have a function `step_tangent`.
    """
    lines = ["", "def member_count():", f"    return {len(counts)}", ""]
    for call, (arguments, name, returns) in (_CALLS | (_TANGENT if tangents else {})).items():
        lines += ["", f"def {call}(arrays, member{arguments}):"]
        start = own
        for member, count in enumerate(counts):
            # Constant borders: a compiler knows the type of each array then.
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
        """Rename a use; local variables of the same name follow, all alike."""
        return ast.copy_location(ast.Name(self._new(node.id), node.ctx), node)

    def visit_arg(self, node: ast.arg) -> ast.arg:
        """Rename a parameter that is called like a function."""
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


_LOOPS = "softneck.runtime._loops_runtime"
_MEMBERS = "softneck.runtime._members_runtime"
_DECLARATIONS = "softneck.runtime._layout"
# Motors and outputs of a neck, for which a text is written where its runtime's name says no others.
_NECK = (3, 2)
# `module@n` reads its sizes from its arrays: one text for all robots, as the compiled library holds it.
ANY_SIZE = "n"
_ALLOWED = {"numpy", "math", "__future__", _DECLARATIONS}


@dataclass(frozen=True, slots=True)
class _Piece:
    """A function or a constant: what it defines, what it reads, and its text."""

    names: frozenset[str]
    reads: frozenset[str]
    text: str


@cache
def bundle(runtime: str, *, loops: bool = True, skip: tuple[str, ...] = (), linked: bool = False) -> str:
    """Return the source text of runtime module `runtime` with all it needs.

    Args:
        runtime: dotted name, with members in brackets.
        loops: add the loops over `step`; false for a module of plain functions.
        skip: functions to leave out, which the caller writes otherwise.
        linked: take the members' functions from where they are compiled already (see `load_runtime`), not their text;
            but for derivatives, which are made of the text.

    Raises:
        SettingsError: a module imports what a runtime must not, or two define the same name.
    """
    outer, members = _members(runtime)
    outer, sizes = _sizes(outer)
    if outer.startswith(PREFIX):
        loop = [piece.text for piece in _pieces(_LOOPS, sizes) if loops and "step" not in piece.names]
        return "\n".join(["import numpy as np", own_text(outer), *loop])
    order: list[str] = []
    _collect(outer, order)
    tangents = any(_asks_for_tangents(module) for module in order)
    # Members of one runtime share its text: what is compiled once need not be compiled for each of them.
    names = [member for member, _ in members]
    homes = [names.index(name) for name in names]
    plain = {i: bundle(names[i], loops=False) for i in dict.fromkeys(homes)}
    if linked and not tangents:
        texts = [_link(names[i], content_name(text), f"m{i}_") for i, text in plain.items()]
    else:
        texts = [prefixed(with_tangent(text) if tangents else text, f"m{i}_") for i, text in plain.items()]
    if members and _MEMBERS in order:
        order.remove(_MEMBERS)
        texts.append(member_calls([count for _, count in members], own_arrays(outer), texts=homes, tangents=tangents))
    found = {module: [piece for piece in _pieces(module, sizes) if not set(skip) & piece.names] for module in order}
    home = next((module for module in order if _defines(found[module], "step")), None)
    if home is not None and not any(_defines(pieces, "state_size") for pieces in found.values()):
        found[home].append(_piece(state_size(declared(home, Arrays), declared(home, StateVector), dict(sizes))))
    if loops:
        found[_LOOPS] = [piece for piece in _pieces(_LOOPS, sizes) if "step" not in piece.names]
    _check_names(found)
    kept = _needed(found, outer, {name for text in texts for name in _read(ast.parse(text))})
    parts = ["# A softneck runtime: generated, do not edit.", "import math", "", "import numpy as np", "", *texts]
    parts += [piece.text for pieces in found.values() for piece in pieces if kept & piece.names]
    return "\n".join(parts)


def content_name(text: str, prefix: str = "softneck") -> str:
    """Return a module name that the content of `text` decides."""
    return f"{prefix}_{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def _link(runtime: str, content: str, prefix: str) -> str:
    """Return lines that take a member's functions from its own module, whose content's name is among them."""
    functions = ("state_size", "initialise", "step")
    lines = [f'{prefix}linked = load_runtime("{runtime}")', f'{prefix}content = "{content}"']
    lines += [f"{prefix}{name} = {prefix}linked.{name}" for name in functions]
    return "\n".join(["from softneck.runtime import load_runtime", "", *lines, f"del load_runtime, {prefix}linked", ""])


def sized(runtime: str, motors: int, outputs: int) -> str:
    """Return the name of a runtime whose text is for so many motors and outputs; that of a neck's is its own."""
    return runtime if (motors, outputs) == _NECK else f"{runtime}@{motors}x{outputs}"


def _sizes(outer: str) -> tuple[str, tuple[tuple[str, int], ...]]:
    """Return the module of a runtime's name, and the motors and outputs that its text is for; none: it reads them."""
    module, _, size = outer.partition("@")
    if size == ANY_SIZE:
        return module, ()
    motors, outputs = map(int, size.split("x")) if size else _NECK
    return module, (("motors", motors), ("outputs", outputs))


def own_arrays(outer: str) -> int:
    """Return how many arrays a module with members reads before those of its members."""
    return len(declared(outer, Arrays).fields)


def declared(module: str, base: type) -> Any:
    """Return the class of arrays or of the state that a module's `step` works on, or else its first function.

    Raises:
        SettingsError: it names none.
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
    """Split at the commas that are in no brackets: members may have members of their own."""
    parts, depth, start = [], 0, 0
    for i, letter in enumerate(inner):
        depth += {"(": 1, ")": -1}.get(letter, 0)
        if letter == "," and depth == 0:
            parts.append(inner[start:i])
            start = i + 1
    return [*parts, inner[start:]]


def _asks_for_tangents(module: str) -> bool:
    """Return whether a module reads how the outputs of its members answer to their inputs."""
    imports = [node for node in _tree(module).body if isinstance(node, ast.ImportFrom) and node.module == _MEMBERS]
    return any(alias.name == "member_tangent" for node in imports for alias in node.names)


def _collect(module: str, order: list[str]) -> None:
    for node in _tree(module).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").endswith("_runtime"):
            _collect(node.module or "", order)
    if module not in order:
        order.append(module)


@cache
def _pieces(module: str, sizes: tuple[tuple[str, int], ...]) -> tuple[_Piece, ...]:
    """Return the functions and constants of a module, with places for names, written for a robot of these sizes."""

    def find(name: str) -> Any:
        return None if hasattr(builtins, name) else getattr(import_module(module), name, None)

    kept: list[_Piece] = []
    for statement in ast.parse(_source(module)).body:  # its own tree, as names become places in it
        node = unrolled(statement, dict(sizes))
        if isinstance(node, ast.Import | ast.ImportFrom):
            _check_import(module, node)
        elif isinstance(node, ast.FunctionDef):
            kept.append(_piece(lowered(node, find, module, dict(sizes))))
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


def _needed(found: dict[str, list[_Piece]], outer: str, others: set[str]) -> set[str]:
    """Return the names that the outer module offers, and all that these, the loops and `others` read."""
    reads = {name: piece.reads for pieces in found.values() for piece in pieces for name in piece.names}
    waiting = ["state_size", *others, *(item for node in _tree(outer).body for item in _imported(node))]
    waiting += [name for module in (outer, _LOOPS) for piece in found.get(module, ()) for name in piece.names]
    kept: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in reads and name not in kept:
            kept.add(name)
            waiting += reads[name]
    return kept


def _imported(node: ast.stmt) -> list[str]:
    return [item.asname or item.name for item in node.names] if isinstance(node, ast.ImportFrom) else []


def _check_import(module: str, node: ast.Import | ast.ImportFrom) -> None:
    imported = [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
    for name in imported:
        # By its full name: whoever has a kind of their own may share text between runtimes, as ours do.
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
