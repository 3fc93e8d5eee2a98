"""Translation of runtimes to C: each function once for each combination of argument types.

numba does the same when it compiles: the types of the arrays determine all others. The output is plain C99 that uses
`sn_base.h` and `sn_vector.h`; a construct without translation is an error that names function and line.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass, field
from functools import cache

from softneck.runtime import TangentError, bundle, with_tangent

from ._expressions import Expressions
from ._kinds import FAST
from ._scope import (
    FLOAT,
    INT,
    MATRIX,
    NONE,
    VECTOR,
    Arrays,
    Bundle,
    CTypes,
    Scope,
    TranslationError,
    Type,
    Value,
    View,
    is_passed_by_pointer,
)
from ._statements import Statements, contains_array

_MEMBERS = {
    "member_size": (2, INT, "sn_member_size(w, {})"),
    "member_initialise": (5, NONE, "sn_member_initialise(w, {})"),
    "member_step": (6, NONE, "sn_member_step(w, {})"),
    "member_tangent": (10, NONE, "sn_member_tangent(w, {})"),
}
# Functions with vectorised C written by hand: types and results as in Python, to the bit.
_BY_HAND: dict[str, tuple[tuple[Type, ...], Type]] = {
    "slant_descend": ((MATRIX, VECTOR, MATRIX, VECTOR, VECTOR, FLOAT, VECTOR, VECTOR), NONE),
    "narx_push": ((VECTOR, VECTOR), NONE),
}


@dataclass(frozen=True, slots=True)
class _TranslatedFunction:
    """A function in C: its name, the type of its result, and the parameters passed by pointer."""

    name: str
    result: Type
    by_pointer: tuple[bool, ...]


@dataclass(slots=True)
class Unit:
    """C of several runtimes; equal functions are written once."""

    types: CTypes = field(default_factory=CTypes)
    functions: list[str] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    steps: list[tuple[str, str]] = field(default_factory=list)
    _bodies: dict[str, str] = field(default_factory=dict)

    def add(self, module: str, ranks: tuple[int, ...], *, tangent: bool = False) -> None:
        """Add runtime `module`, whose arrays have `ranks`, and with `tangent` the derivative of its step.

        Raises TranslationError: it has a construct without translation; the unit is unchanged.
        """
        before = (list(self.types.declarations), list(self.functions), dict(self._bodies))
        arrays = Arrays(ranks)
        try:
            text = bundle(module, loops=False)
            runtime = _Runtime(self, with_single_tangent(text) if tangent else text)
            size = runtime.function("state_size", (arrays,))
            start = runtime.function("initialise", (arrays, VECTOR, VECTOR, VECTOR))
            step = runtime.function("step", (arrays, VECTOR, VECTOR, VECTOR, VECTOR))
            if size.result != INT or start.result != NONE or step.result != NONE:
                raise TranslationError(
                    f"{module}: `state_size` must return a whole number, the other functions must return None."
                )
            moved = _tangent_of(runtime, arrays) if tangent else "NULL"
        except (TranslationError, TangentError) as error:
            self.functions, self._bodies = before[1], before[2]
            raise TranslationError(f"{module}: {error}") from None
        number = len(self.names)
        self.names.append(module)
        self.steps.append((step.name, moved))
        text = ", ".join(map(str, ranks)) or "0"
        self.functions.append(f"static const signed char sn_ranks{number}[] = {{{text}}};\n")
        self.kinds.append(
            f'    {{"{module}", sn_ranks{number}, {len(ranks)}, {int(runtime.has_members)}, '
            f"{size.name}, {start.name}, {step.name}, {moved}}},"
        )

    def text(self) -> str:
        """Return the C file."""
        head = "/* Generated from the runtimes of softneck: do not edit. */\n"
        guard = '#ifndef SN_KINDS_H\n#define SN_KINDS_H\n\n#include "sn_vector.h"\n'
        table = "static const sn_kind sn_kinds[] = {\n" + "\n".join(self.kinds) + "\n};\n"
        count = f"static const int sn_kind_count = {len(self.kinds)};\n"
        fast = self._fast()
        functions = [
            # Fast functions are inline, with inline checks of whole numbers.
            text.replace("sn_int(", "sn_int_here(").replace("\nstatic ", "\nstatic inline ", 1)
            if defined_name(text) in fast
            else text.replace("\nstatic ", "\nSN_SMALL static ", 1)
            for text in self.functions
        ]
        return "\n".join([head, guard, *self.types.declarations, "", *functions, table, count, "#endif\n"])

    def _fast(self) -> set[str]:
        """Return the functions to compile for speed: loops of the steps in `FAST`."""
        pieces = {defined_name(text): text for text in self.functions}
        depths = {name: nested_loops(text) for name, text in pieces.items()}
        return {
            name
            for module, step in zip(self.names, self.steps, strict=True) if module in FAST
            for name in reachable(pieces, step) if depths[name] >= FAST[module]
        }  # fmt: skip

    def keep(self, name: str, text: str) -> str:
        """Add a function whose name is the placeholder @, and return its C name."""
        if text not in self._bodies:
            unique = f"{name}_{len(self._bodies)}"
            self._bodies[text] = unique
            self.functions.append(text.replace("@", unique))
        return self._bodies[text]


class _Runtime:
    """One runtime module under translation."""

    def __init__(self, unit: Unit, text: str) -> None:
        tree = ast.parse(text)
        self.unit = unit
        self.definitions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
        self.constants = _constants(tree)
        # In compiled code, loops with branches are faster than operations on whole arrays.
        self.constants |= {"COMPILED": ast.Constant(True)} if "COMPILED" in self.constants else {}
        self.has_members = "member_step" in self.definitions
        self._done: dict[tuple[str, tuple[Type, ...]], _TranslatedFunction | None] = {}

    def function(self, name: str, arguments: tuple[Type, ...]) -> _TranslatedFunction:
        """Return the C function for these types of arguments."""
        key = (name, arguments)
        if key not in self._done:
            if name not in self.definitions:
                raise TranslationError(f"there is no function `{name}`.")
            self._done[key] = None
            self._done[key] = self._translate(self.definitions[name], arguments)
        done = self._done[key]
        if done is None:
            raise TranslationError(f"`{name}` calls itself.")
        return done

    def _translate(self, node: ast.FunctionDef, arguments: tuple[Type, ...]) -> _TranslatedFunction:
        names = [argument.arg for argument in node.args.args]
        plain = not (node.args.kwonlyargs or node.args.vararg or node.args.kwarg or node.args.defaults)
        if not plain or len(names) != len(arguments):
            raise TranslationError(f"`{node.name}` must be called with all arguments, by position.")
        variables: dict[str, Type] = dict(zip(names, arguments, strict=True))
        bound = {part.id for part in ast.walk(node) if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)}
        by_pointer = {
            name: f"(*v_{name})" for name, kind in variables.items() if is_passed_by_pointer(kind) and name not in bound
        }
        scope = Scope(node.name, self.unit.types, variables)
        scope.by_pointer = by_pointer
        statements = Statements(node, scope, Expressions(scope, self.constants, self._call))
        statements.block(node.body)
        result = NONE if statements.result is None else statements.result
        text = self._text(node, names, arguments, scope, result)
        made = self.unit.keep(re.sub(r"\W", "_", node.name), text)
        return _TranslatedFunction(made, result, tuple(name in by_pointer for name in names))

    def _text(
        self, node: ast.FunctionDef, names: list[str], arguments: tuple[Type, ...], scope: Scope, result: Type
    ) -> str:
        spell = self.unit.types.name
        given = dict(zip(names, arguments, strict=True))
        declared = [
            f"const {spell(kind)} *v_{name}" if name in scope.by_pointer else f"{spell(kind)} v_{name}"
            for name, kind in given.items()
        ]
        # A returned array may be in the workspace: then the caller releases it.
        releases = scope.allocates and not contains_array(result)
        own = [
            (f"v_{name}", kind)
            for name, kind in scope.variables.items()
            if name not in given and name not in scope.by_pointer
        ]
        lines = [f"{spell(kind)} {name}{_zero(kind)};" for name, kind in own + scope.temporaries]
        lines += ["size_t top = w->top;"] if releases else []
        lines += [f"{spell(result)} result{_zero(result)};"] if result != NONE else []
        lines += [f"(void){name};" for name in ("w", *(f"v_{name}" for name in names))]
        lines += scope.lines
        lines += ["leave: ;"] if "goto leave;" in scope.lines else []
        lines += ["w->top = top;"] if releases else []
        lines += ["return result;"] if result != NONE else []
        head = f"static SN_INSIDE {spell(result)} @({', '.join(['sn_work *w', *declared])})"
        return f"/* {node.name} */\n{head}\n{{\n{indent(lines)}\n}}\n"

    def _call(self, node: ast.Call, ex: Expressions) -> Value | None:
        """Return the C of a call of a function of this runtime; None for other functions."""
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name == "member_count" and self.has_members:
            arrays = next(key for key, kind in ex.scope.variables.items() if isinstance(kind, Arrays))
            return Value(f"(int64_t)v_{arrays}->member_count", INT)
        if name not in self.definitions:
            return None
        if node.keywords:
            raise ex.scope.fail(node, "keyword arguments are not supported here.")
        values = ex.evaluate_all(node.args)
        if name in _MEMBERS:
            count, kind, code = _MEMBERS[name]
            if len(values) != count:
                raise ex.scope.fail(node, f"`{name}` takes {count} arguments.")
            value = Value(code.format(", ".join(map(ex.scope.argument, values))), kind)
        elif name == "tanh_each":
            filled = ex.scope.temporary(values[0].type)
            count = len(values[0].type.items) if isinstance(values[0].type, Bundle) else 0
            ex.scope.emit(f"sn_tanh_each(w, {count}, ({ex.scope.argument(values[0])})->f, {filled}.f);")
            return Value(filled, values[0].type)
        elif _BY_HAND.get(name, ((), NONE))[0] == tuple(value.type for value in values):
            kind = _BY_HAND[name][1]
            arguments = "".join(f", {ex.scope.argument(value)}" for value in values)
            value = Value(f"sn_{name}(w{arguments})", kind)
        else:
            done = self.function(name, tuple(value.type for value in values))
            codes = [
                ex.scope.place(value) if by_pointer else value.code
                for value, by_pointer in zip(values, done.by_pointer, strict=True)
            ]
            arguments = "".join(f", {code}" for code in codes)
            value = Value(f"{done.name}(w{arguments})", done.result)
        if value.type == NONE:
            ex.scope.emit(f"{value.code};")
            return Value("", NONE)
        ex.scope.allocates |= contains_array(value.type)
        return ex.scope.store(value)


def _tangent_of(runtime: _Runtime, arrays: Arrays) -> str:
    rows = (MATRIX, MATRIX, MATRIX)
    return runtime.function("step_tangent", (arrays, VECTOR, VECTOR, VECTOR, VECTOR, *rows, INT)).name


def _constants(tree: ast.Module) -> dict[str, ast.expr]:
    """Return the constants of a runtime: `A = 1`, and `A, B = 1, 2`."""
    found: dict[str, ast.expr] = {}
    for node in tree.body:
        if not isinstance(node, ast.Assign):
            continue
        for target in node.targets:
            if isinstance(target, ast.Name):
                found[target.id] = node.value
            elif isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                names = [part.id if isinstance(part, ast.Name) else "" for part in target.elts]
                found.update(zip(names, node.value.elts, strict=False))
    return found


def indent(lines: list[str]) -> str:
    """Return C statements indented by their open brackets."""
    depth, shown = 1, []
    for line in lines:
        shown.append("    " * (depth - line.startswith("}")) + line)
        depth += line.count("{") - line.count("}")
    return "\n".join(shown)


def _zero(kind: Type) -> str:
    if isinstance(kind, View | Bundle):
        return " = {0}"
    return " = NULL" if isinstance(kind, Arrays) else " = 0"


@cache
def with_single_tangent(text: str) -> str:
    """Return the bundle `text` with its `step_tangent` (see `softneck.runtime._tangent`) for a single direction.

    Raises TangentError: the step has no derivative.
    """
    return ast.unparse(ast.fix_missing_locations(_OneDirection().visit(ast.parse(with_tangent(text)))))


class _OneDirection(ast.NodeTransformer):
    def __init__(self) -> None:
        self._direction = ""

    def visit_For(self, node: ast.For) -> ast.AST | list[ast.stmt]:
        """Return the body of a loop over directions; other loops stay."""
        if ast.unparse(node.iter) != "range(moved)":
            return self.generic_visit(node)
        self._direction = ast.unparse(node.target)
        body = [self.visit(statement) for statement in node.body]
        self._direction = ""
        return body

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Replace the loop variable of the directions by 0."""
        return ast.Constant(0) if node.id == self._direction else node


_DEFINED = re.compile(r"^(?:SN_SMALL )?static [^(\[=;]*?(\w+)[(\[]", re.MULTILINE)
_NUMBERED = re.compile(r"\w+\d\b")
_ENTRY = re.compile(r'^    \{"([^"]+)", .*\},\n', re.MULTILINE)
_COUNT = re.compile(r"(sn_kind_count = )\d+")


def defined_name(piece: str) -> str:
    """Return the name of the function or table that a piece of generated C defines; "" for none."""
    found = _DEFINED.search(piece)
    return found[1] if found else ""


def reachable(pieces: Mapping[str, str], roots: Iterable[str]) -> set[str]:
    """Return the names of the pieces that `roots` use, directly or indirectly; all names are numbered."""
    found: set[str] = set()
    waiting = [name for name in roots if name in pieces]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += [word for word in set(_NUMBERED.findall(pieces[name])) if word in pieces]
    return found


def nested_loops(piece: str) -> int:
    """Return the depth of nested loops of a function; 0 without loops."""
    depth, most = 0, 0
    open_loops: list[int] = []
    for line in piece.splitlines():
        if line.lstrip().startswith("for ("):
            open_loops.append(depth)
            most = max(most, len(open_loops))
        depth += line.count("{") - line.count("}")
        while open_loops and depth <= open_loops[-1]:
            open_loops.pop()
    return most


def select_kinds(text: str, modules: Set[str]) -> str:
    """Return `sn_kinds.h` with only the runtimes `modules`."""
    left_out = [entry[0] for entry in _ENTRY.finditer(text) if entry[1] not in modules]
    for entry in left_out:
        text = text.replace(entry, "")
    text = _COUNT.sub(rf"\g<1>{len(_ENTRY.findall(text))}", text)
    # Functions are separated by empty lines and contain none.
    pieces = text.split("\n\n")
    functions = {defined_name(piece): piece for piece in pieces if _is_function(piece)}
    roots = [word for entry in _ENTRY.finditer(text) for word in _NUMBERED.findall(entry[0])]
    needed = reachable(functions, roots)
    return "\n\n".join(piece for piece in pieces if not _is_function(piece) or defined_name(piece) in needed)


def _is_function(piece: str) -> bool:
    return bool(re.search(r"\d$", defined_name(piece)))
