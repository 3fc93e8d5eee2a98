"""One function on its way to C: types and how C spells them, its variables, and the lines written so far."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from softneck.core import SettingsError


class TranslationError(SettingsError):
    """A runtime uses something that the translator to C does not know."""


@dataclass(frozen=True, slots=True)
class Scalar:
    """A number: "int", "float" or "bool"."""

    name: str


@dataclass(frozen=True, slots=True)
class View:
    """An array of `rank` dimensions; `whole` for one of whole numbers."""

    rank: int
    whole: bool = False


@dataclass(frozen=True, slots=True)
class Bundle:
    """A tuple."""

    items: tuple[Type, ...]


@dataclass(frozen=True, slots=True)
class Arrays:
    """The arrays of a model: their ranks."""

    ranks: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Nothing:
    """What a function without `return` gives."""


Type = Scalar | View | Bundle | Arrays | Nothing
INT, FLOAT, BOOL, NONE = Scalar("int"), Scalar("float"), Scalar("bool"), Nothing()
VECTOR, MATRIX = View(1), View(2)
_SCALARS = {"int": "int64_t", "float": "double", "bool": "int"}


@dataclass(frozen=True, slots=True)
class Value:
    """An expression: its C text and type, and its value where the translator knows that already."""

    code: str
    type: Type
    known: int | float | bool | None = None


def lends(kind: Type) -> bool:
    """Return whether a parameter is read where the caller keeps it: it is more than two registers hold."""
    return isinstance(kind, Bundle) or (isinstance(kind, View) and kind.rank > 1)


def length(code: str, kind: View, dimension: int) -> str:
    """Return C of the length of an array along one dimension; arrays hold it in 32 bits, all counting is in 64."""
    return f"(int64_t){code}.n{'' if kind.rank == 1 else dimension}"


def unified(first: Type, second: Type, where: str) -> Type:
    """Return the type that holds both: whole numbers become floats, all else must be equal."""
    if first == second:
        return first
    if isinstance(first, Scalar) and isinstance(second, Scalar):
        return FLOAT if FLOAT in (first, second) else INT
    if isinstance(first, Bundle) and isinstance(second, Bundle) and len(first.items) == len(second.items):
        pairs = zip(first.items, second.items, strict=True)
        return Bundle(tuple(unified(a, b, where) for a, b in pairs))
    raise TranslationError(f"{where}: one name stands for {first} and for {second}.")


class CTypes:
    """Names of C types; tuples become structs, which are declared on the way."""

    def __init__(self) -> None:
        self.declarations: list[str] = []
        self._structs: dict[Bundle, str] = {}

    def name(self, kind: Type) -> str:
        """Return the C type."""
        if isinstance(kind, Scalar):
            return _SCALARS[kind.name]
        if isinstance(kind, View):
            return f"sn_i{kind.rank}" if kind.whole else f"sn_v{kind.rank}"
        if isinstance(kind, Arrays):
            return "const sn_node *"
        return "void" if isinstance(kind, Nothing) else self._struct(kind)

    def field(self, kind: Bundle, index: int) -> str:
        """Return how entry `index` of a tuple is reached."""
        return f".f[{index}]" if uniform(kind) else f".f{index}"

    def _struct(self, kind: Bundle) -> str:
        if kind not in self._structs:
            members = [self.name(item) for item in kind.items]
            if uniform(kind):
                body = f"{members[0]} f[{len(members)}];"
            else:
                body = " ".join(f"{member} f{i};" for i, member in enumerate(members))
            name = f"sn_t{len(self._structs)}"
            self._structs[kind] = name
            self.declarations.append(f"typedef struct {{ {body} }} {name};")
        return self._structs[kind]


def uniform(kind: Bundle) -> bool:
    """Return whether all entries are of one type, so that a variable may choose among them."""
    return len(set(kind.items)) == 1


# A variable, an array of the model, or what a parameter points to; and an entry of a tuple in one.
_PLACE = re.compile(r"(?:[a-z]\w*|\(\*\w+\)|v_\w+->arrays\[\d+\]\.v\d)(?:\.f\d+|\.f\[\d+\])*")


class Scope:
    """What a function translator writes into.

    Attributes:
        lines: of C.
        variables: name -> type, widened from pass to pass.
        allocates: whether the function takes room in the workspace.
        lent: parameter, or a part of one under its own name -> C, for those that are read where the caller keeps them.
    """

    def __init__(self, function: str, types: CTypes, variables: dict[str, Type]) -> None:
        self.function, self.types, self.variables = function, types, variables
        self.lines: list[str] = []
        self.temporaries: list[tuple[str, Type]] = []
        self.allocates = False
        self.lent: dict[str, str] = {}
        self.widened = False

    def emit(self, line: str) -> None:
        """Write one line."""
        self.lines.append(line)

    def fail(self, node: ast.AST, text: str) -> TranslationError:
        """Return the error that says which part of the function cannot be translated."""
        shown = ast.unparse(node) if isinstance(node, ast.expr | ast.stmt) else type(node).__name__
        return TranslationError(f"{self.function}: `{shown.splitlines()[0][:80]}`: {text}")

    def bind(self, name: str, kind: Type) -> Type:
        """Give a variable a type that holds `kind` beside what it held before, and return that."""
        before = self.variables.get(name)
        after = kind if before is None else unified(before, kind, f"{self.function}: `{name}`")
        if after != before:
            self.variables[name] = after
            self.widened = True
        return after

    def temporary(self, kind: Type) -> str:
        """Return the name of a new C variable."""
        name = f"t{len(self.temporaries)}"
        self.temporaries.append((name, kind))
        return name

    def stands(self, value: Value) -> bool:
        """Return whether `value` has a place that no variable chooses."""
        return _PLACE.fullmatch(value.code) is not None

    def place(self, value: Value) -> str:
        """Return C of the place where `value` stands."""
        if self.stands(value):
            return value.code[2:-1] if value.code.startswith("(*") and value.code.endswith(")") else f"&{value.code}"
        return f"&{self.kept(value).code}"

    def given(self, value: Value) -> str:
        """Return C of an argument: matrices, cubes and tuples are read where they stand, all else is handed over."""
        return self.place(value) if lends(value.type) else value.code

    def kept(self, value: Value) -> Value:
        """Return `value` in a variable of its own, evaluated here."""
        if value.known is not None:
            return value
        name = self.temporary(value.type)
        self.emit(f"{name} = {value.code};")
        return Value(name, value.type)

    @contextmanager
    def captured(self) -> Iterator[list[str]]:
        """Collect lines apart from those written so far."""
        outside, self.lines = self.lines, []
        try:
            yield self.lines
        finally:
            self.lines = outside

    def taken_back(self, before: int) -> list[str]:
        """Take back the lines written since there were `before` of them, and return them."""
        written = self.lines[before:]
        del self.lines[before:]
        return written

    def cast(self, value: Value, kind: Type) -> str:
        """Return C that turns `value` into `kind`, which holds it."""
        if value.type == kind:
            return value.code
        if isinstance(value.type, Scalar) and isinstance(kind, Scalar):
            if kind == FLOAT and value.known is not None:
                return repr(float(value.known))
            if kind == FLOAT:
                return f"((double)({value.code}))"
            if kind == INT and value.type == BOOL:
                return f"((int64_t)({value.code}))"
        if isinstance(value.type, Bundle) and isinstance(kind, Bundle):
            held = self.kept(value)
            items = [
                self.cast(Value(held.code + self.types.field(value.type, i), item), kind.items[i])
                for i, item in enumerate(value.type.items)
            ]
            return self.bundled(items, kind)
        raise TranslationError(f"{self.function}: {value.type} cannot become {kind}.")

    def bundled(self, items: list[str], kind: Bundle) -> str:
        """Return C of a tuple, in a variable of its own."""
        name = self.temporary(kind)
        for i, item in enumerate(items):
            self.emit(f"{name}{self.types.field(kind, i)} = {item};")
        return name
