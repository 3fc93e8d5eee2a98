"""Translation state of one function: types and their C names, variables, and the lines written so far."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from softneck.core import SettingsError


class TranslationError(SettingsError):
    """A runtime uses a construct without a translation to C."""


@dataclass(frozen=True, slots=True)
class Scalar:
    """A number: "int", "float" or "bool"."""

    name: str


@dataclass(frozen=True, slots=True)
class View:
    """An array of `rank` dimensions; `whole` if of whole numbers."""

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
    """The result of a function without `return`."""


Type = Scalar | View | Bundle | Arrays | Nothing
INT, FLOAT, BOOL, NONE = Scalar("int"), Scalar("float"), Scalar("bool"), Nothing()
VECTOR, MATRIX = View(1), View(2)
_SCALARS = {"int": "int64_t", "float": "double", "bool": "int"}


@dataclass(frozen=True, slots=True)
class Value:
    """An expression: its C text and type, and its value if constant."""

    code: str
    type: Type
    known: int | float | bool | None = None


def is_passed_by_pointer(kind: Type) -> bool:
    """Return whether a parameter is passed by pointer: it does not fit two registers."""
    return isinstance(kind, Bundle) or (isinstance(kind, View) and kind.rank > 1)


def length(code: str, kind: View, dimension: int) -> str:
    """Return C of the length of an array along one dimension; stored in 32 bits, converted to 64."""
    return f"(int64_t){code}.n{'' if kind.rank == 1 else dimension}"


def one_type(first: Type, second: Type, where: str) -> Type:
    """Return the type of a name or a result, which has the same everywhere."""
    if first != second:
        raise TranslationError(f"{where} has the types {first} and {second}.")
    return first


class CTypes:
    """Names of C types; tuples become structs, which are declared when first used."""

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
        """Return the C access to entry `index` of a tuple."""
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
    """Return whether all entries have one type, so that a variable index is possible."""
    return len(set(kind.items)) == 1


# A variable, an array of the model, or the target of a pointer parameter; or an entry of a tuple in one of these.
_PLACE = re.compile(r"(?:[a-z]\w*|\(\*\w+\)|v_\w+->arrays\[\d+\]\.v\d)(?:\.f\d+|\.f\[\d+\])*")


class Scope:
    """Variables and lines of a function under translation.

    `lines`: of C. `variables`: name -> type. `allocates`: whether the function allocates
    workspace. `by_pointer`: parameter passed by pointer, or a named part of one -> C.
    """

    def __init__(self, function: str, types: CTypes, variables: dict[str, Type]) -> None:
        self.function, self.types, self.variables = function, types, variables
        self.lines: list[str] = []
        self.temporaries: list[tuple[str, Type]] = []
        self.allocates = False
        self.by_pointer: dict[str, str] = {}

    def emit(self, line: str) -> None:
        """Write one line."""
        self.lines.append(line)

    def fail(self, node: ast.AST, text: str) -> TranslationError:
        """Return the error that names the part of the function without translation."""
        shown = ast.unparse(node) if isinstance(node, ast.expr | ast.stmt) else type(node).__name__
        return TranslationError(f"{self.function}: `{shown.splitlines()[0][:80]}`: {text}")

    def bind(self, name: str, kind: Type) -> None:
        """Give a variable its type."""
        one_type(self.variables.setdefault(name, kind), kind, f"{self.function}: `{name}`")

    def temporary(self, kind: Type) -> str:
        """Return the name of a new C variable."""
        name = f"t{len(self.temporaries)}"
        self.temporaries.append((name, kind))
        return name

    def has_place(self, value: Value) -> bool:
        """Return whether `value` has an address that does not depend on a variable index."""
        return _PLACE.fullmatch(value.code) is not None

    def place(self, value: Value) -> str:
        """Return C of the address of `value`; values without one are stored first."""
        if self.has_place(value):
            return value.code[2:-1] if value.code.startswith("(*") and value.code.endswith(")") else f"&{value.code}"
        return f"&{self.store(value).code}"

    def argument(self, value: Value) -> str:
        """Return C of an argument: matrices, cubes and tuples by address, others by value."""
        return self.place(value) if is_passed_by_pointer(value.type) else value.code

    def store(self, value: Value) -> Value:
        """Evaluate `value` into a new variable and return that; constants stay as they are."""
        if value.known is not None:
            return value
        name = self.temporary(value.type)
        self.emit(f"{name} = {value.code};")
        return Value(name, value.type)

    @contextmanager
    def capture(self) -> Iterator[list[str]]:
        """Collect the lines written inside the context separately."""
        outside, self.lines = self.lines, []
        try:
            yield self.lines
        finally:
            self.lines = outside

    def cut_lines(self, before: int) -> list[str]:
        """Remove the lines after the first `before` and return them."""
        written = self.lines[before:]
        del self.lines[before:]
        return written

    def cast(self, value: Value, kind: Type) -> str:
        """Return C of `value` as `kind`: numbers become floats, other types must be equal."""
        if value.type == kind:
            return value.code
        if kind != FLOAT or not isinstance(value.type, Scalar):
            raise TranslationError(f"{self.function}: {value.type} cannot become {kind}.")
        return f"((double)({value.code}))" if value.known is None else repr(float(value.known))

    def make_tuple(self, items: list[str], kind: Bundle) -> str:
        """Return C of a tuple, in a new variable."""
        name = self.temporary(kind)
        for i, item in enumerate(items):
            self.emit(f"{name}{self.types.field(kind, i)} = {item};")
        return name
