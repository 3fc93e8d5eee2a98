"""Layouts: each kind declares its arrays and its state once, with names, beside its equations.

    class LagArrays(Arrays):
        poles = array("n", "a of y+ = a y + (1 - a) u")

    class LagState(StateVector):
        y = cells("n", "outputs of now")

    def step(p: LagArrays, parameters, x: LagState, inputs, outputs):
        for i in range(p.n):
            x.y[i] = p.poles[i] * x.y[i] + (1.0 - p.poles[i]) * inputs[i]

The layout determines the order in the file, the checks of shapes, the ranks in C, the length of the state and the
reference page. The arrays stay a tuple and the state stays one vector: a bundle replaces names by indices (see
`_names`), so that numba and C see plain indices. A subclass adds its fields after those of its base.

Shapes are written in symbols: `n` takes the length of the array, `2 * n + 1` must fit it, `n = 1 | 3` takes it if it is
one of these, and `value` defines a symbol by an entry that holds a whole number.
"""

from __future__ import annotations

import ast
import dataclasses
import math
import operator
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from softneck.core import FileFormatError, Matrix, SettingsError

_PARSE_LOCK = threading.Lock()
_OPERATORS: dict[type, Callable[[int, int], int]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.FloorDiv: operator.floordiv,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Field:
    """One array, or one part of a state.

    Attributes:
        shape: the length along each dimension, in symbols; empty for a single number of a state.
        meaning: one line with the unit, for the reference page.
        open: the rest of the state, of any length.
        allowed: symbol of `shape` -> the lengths that it may have.
    """

    shape: tuple[str, ...]
    meaning: str
    open: bool = False
    allowed: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Symbol:
    """A length that is read from an entry of an array, or computed by a function of the runtime.

    A `written` symbol is a constant in the text, which is generated for each size (see `_bundle.sized_name`): loops
    over the three motors of a neck are as fast as with a fixed number of motors.
    """

    array: str
    places: tuple[int, ...] = ()
    function: Callable[..., int] | None = None
    written: bool = False


def array(shape: str, meaning: str) -> Any:
    """Declare an array of `shape`, such as `"2, hidden, n"`."""
    pairs = [text.partition("=") for text in _split(shape)]
    allowed = {
        name.strip(): tuple(text.strip() for text in lengths.split("|")) for name, equals, lengths in pairs if equals
    }
    return Field(tuple(name.strip() for name, _, _ in pairs), meaning, allowed=allowed)


def cells(shape: str, meaning: str) -> Any:
    """Declare a part of a state of `shape`: `"H, 3"`, or `""` for a number."""
    return Field(_split(shape), meaning)


def rest(meaning: str) -> Any:
    """Declare the last part of a state, which holds the states of a composed kind's members."""
    return Field((), meaning, open=True)


def value(array_name: str, *places: int, function: Callable[..., int] | None = None, written: bool = False) -> Any:
    """Declare a symbol: the whole number at `places` of an array, or `function` of that array."""
    return Symbol(array_name, places, function, written)


class _Layout:
    fields: ClassVar[dict[str, Field]] = {}
    symbols: ClassVar[dict[str, Symbol]] = {}

    def __init_subclass__(cls) -> None:
        own = {name: item for name, item in vars(cls).items() if isinstance(item, Field)}
        cls.fields = cls.fields | own
        cls.symbols = cls.symbols | {name: item for name, item in vars(cls).items() if isinstance(item, Symbol)}

    if TYPE_CHECKING:  # symbols of shapes are names as well; a bundle refuses one that is not declared

        def __getattr__(self, name: str) -> Any: ...


class Arrays(_Layout):
    """A kind's arrays with names: `NnArrays(model.arrays.values()).W1`; inside a runtime, a parameter's annotation."""

    def __init__(self, arrays: Sequence[Matrix]) -> None:
        """Name `arrays`, which come in the order of the declaration; members of a composed kind may follow."""
        for name, item in zip(self.fields, arrays, strict=False):
            setattr(self, name, item)

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names in the order of file and runtime."""
        return tuple(cls.fields)

    @classmethod
    def ranks(cls) -> tuple[int, ...]:
        """Return the number of dimensions of each array."""
        return tuple(len(item.shape) for item in cls.fields.values())

    @classmethod
    def place(cls, name: str) -> int:
        """Return the place of an array among all."""
        return cls.names().index(name)

    @classmethod
    def read(cls, arrays: Mapping[str, np.ndarray]) -> dict[str, Matrix]:
        """Return a file's arrays in the order of the declaration.

        Raises FileFormatError: an array whose shape does not fit the others, or whose numbers are not finite.
        """
        found: dict[str, Matrix] = {name: np.ascontiguousarray(arrays[name], dtype=np.float64) for name in cls.fields}
        for name, item in found.items():
            if not np.isfinite(item).all():
                raise FileFormatError(f"its array `{name}` holds numbers that are not finite.")
        cls.lengths(found)
        return found

    @classmethod
    def lengths(cls, arrays: Mapping[str, Matrix]) -> dict[str, int]:
        """Return the symbols of the shapes of `arrays`.

        Raises FileFormatError: an array whose shape does not fit the others.
        """
        known: dict[str, int] = {}
        # Plain symbols first: `k * n` may come before the array with length k.
        for name, item in cls.fields.items():
            for text, length in zip(item.shape, arrays[name].shape, strict=False):
                if text.isidentifier():
                    known.setdefault(text, length)
        for name, item in cls.fields.items():
            found = arrays[name].shape
            if len(found) == len(item.shape):
                wanted = tuple(evaluate(text, known) for text in item.shape)
            else:
                wanted = tuple(known.get(text, text) for text in item.shape)
            if found != wanted:
                shown = str(wanted).replace("'", "")
                raise FileFormatError(f"its array `{name}` has shape {found}; {shown} is needed.")
            for symbol, source in cls.symbols.items():
                if source.array == name:
                    known[symbol] = _found(source, arrays[name])
        cls._check_allowed(known)
        return known

    @classmethod
    def _check_allowed(cls, known: Mapping[str, int]) -> None:
        for name, item in cls.fields.items():
            for symbol, texts in item.allowed.items():
                lengths = [evaluate(text, known) for text in texts]
                if known[symbol] not in lengths:
                    wanted = " or ".join(map(str, lengths))
                    raise FileFormatError(f"its array `{name}` has the length {known[symbol]}; {wanted} is needed.")


class StateVector(_Layout):
    """A kind's state with names; inside a runtime, the annotation of the state vector."""

    if TYPE_CHECKING:  # it is a vector

        def __getitem__(self, at: Any) -> Any: ...
        def __setitem__(self, at: Any, value: Any) -> None: ...

    @classmethod
    def parts(cls, arrays: Arrays) -> dict[str, slice]:
        """Return where each part is in the state vector of a model with `arrays`."""
        known = type(arrays).lengths(vars(arrays))
        at, found = 0, {}
        for name, item in cls.fields.items():
            size = math.prod(evaluate(text, known) for text in item.shape)
            found[name] = slice(at, None if item.open else at + size)
            at += size
        return found

    @classmethod
    def size(cls, arrays: Arrays) -> int:
        """Return the length of all parts but an open one; in a runtime's text too."""
        return max(part.start if part.stop is None else part.stop for part in cls.parts(arrays).values())


def evaluate(text: str, known: Mapping[str, int]) -> int:
    """Return the value of a length such as `3 * (1 + widths)`."""

    def term(node: ast.expr) -> int:
        if isinstance(node, ast.Constant) and isinstance(node.value, int):
            return node.value
        if isinstance(node, ast.Name) and node.id in known:
            return known[node.id]
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            return _OPERATORS[type(node.op)](term(node.left), term(node.right))
        raise SettingsError(f"the length `{text}` of a layout may only use {', '.join(known) or 'numbers'}.")

    return term(_parse_length(text))


@cache
def _parse_length(text: str) -> ast.expr:
    # Python 3.11 raises SystemError where two threads parse at once, as those of set membership do.
    with _PARSE_LOCK:
        return ast.parse(text, mode="eval").body


def _found(symbol: Symbol, source: Matrix) -> int:
    return symbol.function(source) if symbol.function is not None else int(source[symbol.places])


def _split(shape: str) -> tuple[str, ...]:
    return tuple(text.strip() for text in shape.split(",") if text.strip())
