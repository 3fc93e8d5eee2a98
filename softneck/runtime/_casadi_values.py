"""Arithmetic of a runtime on arrays that mix numbers and CasADi symbols.

An array is a numpy array of objects, Python floats and scalar `casadi.SX` mixed: its slices are views, so a runtime can
write through them, and known entries stay numbers.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np

_NUMPY_NAMES = {
    "abs": "fabs", "absolute": "fabs", "arctan": "atan", "arcsin": "asin", "arccos": "acos", "arctan2": "atan2",
    "maximum": "fmax", "minimum": "fmin",
}  # fmt: skip
_UNARY_FUNCTIONS = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "fabs")
_BINARY_FUNCTIONS = ("atan2", "hypot", "fmax", "fmin")
_KNOWN_TWO: dict[str, Callable[..., Any]] = {
    "atan2": math.atan2, "hypot": math.hypot, "fmax": max, "fmin": min,
}  # fmt: skip
_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.Mod: operator.mod, ast.FloorDiv: operator.floordiv, ast.Lt: operator.lt,
    ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Eq: operator.eq, ast.NotEq: operator.ne,
}  # fmt: skip
_KNOWN_ONLY = (ast.Mod, ast.FloorDiv)


class Values:
    """Arithmetic on numbers, symbols, and arrays of both.

    Attributes:
        under: the condition under which the current value is used; None if always. In the branch of an `if` that is not
            taken, a division by zero is harmless as a value, but zero times its derivative is not a number.
    """

    def __init__(self) -> None:
        """Start outside all conditions."""
        import casadi

        self._ca = casadi
        self.under: Any = None

    def symbolic(self, value: Any) -> bool:
        """Return whether `value` is a symbol, or an array that holds one."""
        if isinstance(value, np.ndarray):
            return value.dtype == object and any(isinstance(item, self._ca.SX) for item in value.flat)
        return isinstance(value, self._ca.SX)

    def operate(self, op: ast.AST, left: Any, right: Any) -> Any:
        """Return `left op right`, entry by entry."""
        function = _OPERATORS.get(type(op))
        if function is None or (isinstance(op, _KNOWN_ONLY) and (self.symbolic(left) or self.symbolic(right))):
            raise TypeError(f"the operator {type(op).__name__} is not one for symbols")
        if isinstance(op, ast.Div):
            return self.each(lambda a, b: a / self._apart(b), left, right)
        return self.each(function, left, right)

    def call(self, name: str, *values: Any) -> Any:
        """Return a function of `math` or numpy, entry by entry."""
        name = _NUMPY_NAMES.get(name, name)
        if name in _UNARY_FUNCTIONS and len(values) == 1:
            return self.each(lambda a: self._one(name, a), *values)
        if name in _BINARY_FUNCTIONS and len(values) == 2:
            return self.each(lambda a, b: self._two(name, a, b), *values)
        raise TypeError(f"the function `{name}` is not known here")

    def _one(self, name: str, a: Any) -> Any:
        if not self.symbolic(a):
            return getattr(math, name)(a)
        if name == "sqrt":
            # The derivative of a root is infinite at zero. Roots here are lengths of vectors, which have a kink there:
            # 0 is between its one-sided slopes.
            zero = a == 0.0
            return self.choose(zero, 0.0, self._ca.sqrt(self.choose(zero, 1.0, self._apart(a))))
        return getattr(self._ca, name)(self._apart(a) if name == "log" else a)

    def _two(self, name: str, a: Any, b: Any) -> Any:
        if not (self.symbolic(a) or self.symbolic(b)):
            return _KNOWN_TWO[name](a, b)
        return self._one("sqrt", a * a + b * b) if name == "hypot" else getattr(self._ca, name)(a, b)

    def _apart(self, value: Any) -> Any:
        """Return the value (a divisor, or an argument of log) where its branch is taken, and 1 elsewhere."""
        if self.under is None or not (self.symbolic(value) or value == 0.0):
            return value
        return self.choose(self.under, value, 1.0)

    def choose(self, test: Any, yes: Any, no: Any) -> Any:
        """Return `yes` where `test`, else `no`, entry by entry."""
        if yes is no:
            return yes
        if isinstance(yes, tuple) and isinstance(no, tuple) and len(yes) == len(no):
            return tuple(self.choose(test, a, b) for a, b in zip(yes, no, strict=True))
        if len({value.shape if isinstance(value, np.ndarray) else () for value in (yes, no)}) > 1:
            raise TypeError("the branches of a test on symbols leave arrays of two shapes")
        return self.each(lambda a, b: a if _same(a, b) else self._ca.if_else(test, a, b), yes, no)

    def both(self, first: Any, second: Any) -> Any:
        """Return the conjunction of two conditions; the first may be None."""
        return second if first is None else self._ca.logic_and(first, second)

    def either(self, first: Any, second: Any) -> Any:
        """Return the disjunction of two conditions."""
        return self._ca.logic_or(first, second)

    def inverse(self, test: Any) -> Any:
        """Return the negation of a condition."""
        return self._ca.logic_not(test)

    def extreme(self, name: str, values: list[Any]) -> Any:
        """Return the largest ("fmax") or smallest ("fmin") of several numbers."""
        return reduce(lambda a, b: self._two(name, a, b), values)

    def dot(self, left: Any, right: Any) -> Any:
        """Return the product of vectors and matrices."""
        return plain(np.dot(np.asarray(left).astype(object), np.asarray(right).astype(object)))

    def sort(self, values: np.ndarray) -> np.ndarray:
        """Return a sorted vector; symbols are sorted by a sorting network."""
        row = list(values)
        for end in range(len(row) - 1, 0, -1):
            for i in range(end):
                row[i : i + 2] = self._two("fmin", *row[i : i + 2]), self._two("fmax", *row[i : i + 2])
        return fill(np.empty(len(row), dtype=object), row)

    def each(self, function: Callable[..., Any], *values: Any) -> Any:
        """Return `function` of the entries of arrays, broadcast as numpy does, or of numbers."""
        if not any(isinstance(value, np.ndarray) for value in values):
            return function(*values)
        return np.frompyfunc(function, len(values), 1)(*(as_objects(value) for value in values))


def as_objects(value: Any) -> np.ndarray:
    """Return an array of objects; a number becomes one without axes, so that numpy does not convert symbols."""
    if isinstance(value, np.ndarray):
        return value.astype(object)
    box = np.empty((), dtype=object)
    box[()] = value
    return box


def plain(value: Any) -> Any:
    """Return a numpy scalar as a Python number, which leaves arithmetic to the other, symbolic operand."""
    return value.item() if isinstance(value, np.generic) else value


def fill(array: np.ndarray, values: list[Any]) -> np.ndarray:
    """Write `values` into a vector, one by one, and return it."""
    for i, value in enumerate(values):
        array[i] = plain(value)
    return array


def _same(a: Any, b: Any) -> bool:
    """Return whether two entries are equal; symbols are compared by identity."""
    return a is b or (isinstance(a, float | int) and isinstance(b, float | int) and type(a) is type(b) and a == b)
