"""Types of the Python that runtimes are written in, and how C spells them."""

from __future__ import annotations

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
