"""Translation of expressions to C.

Every result is one term of C or in brackets. Python evaluates from left to right, C in no fixed order: before an
operand writes statements of its own, the operands before it are stored in variables.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from typing import Any

from ._calls import array_of, method, numpy_call, plain_call
from ._scope import (
    BOOL,
    FLOAT,
    INT,
    MATRIX,
    VECTOR,
    Arrays,
    Bundle,
    Scalar,
    Scope,
    Type,
    Value,
    View,
    length,
    one_type,
    uniform,
)

_ARITHMETIC = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.Div: "div"}
_SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_CONSTANTS = {"pi": "SN_PI", "inf": "HUGE_VAL", "nan": "sn_from_bits(0x7ff8000000000000u)", "e": "2.718281828459045"}
# A product with a factor up to this cannot overflow int64, as `sn_int` limits whole numbers to 2^53.
_SMALL_FACTOR = 512
_LARGEST_POWER = 16


class Expressions:
    """Translator of the expressions of one function; `own` translates calls of the runtime's own functions."""

    def __init__(self, scope: Scope, constants: dict[str, ast.expr], own: Callable[..., Value | None]) -> None:
        self.scope, self.constants, self._own = scope, constants, own

    def value(self, node: ast.expr) -> Value:
        """Return the C of an expression, after writing the statements that it needs."""
        handler: Callable[[Any], Value] | None = getattr(self, f"_{type(node).__name__.lower()}", None)
        if handler is None:
            raise self.scope.fail(node, "there is no translation to C for this.")
        return handler(node)

    def evaluate_all(self, nodes: list[ast.expr]) -> list[Value]:
        """Return the C of several expressions, evaluated from left to right."""
        values: list[Value] = []
        for node in nodes:
            before = len(self.scope.lines)
            value = self.value(node)
            if len(self.scope.lines) > before and values:
                written = self.scope.cut_lines(before)
                values = [v if self._is_fixed(v) else self.scope.store(v) for v in values]
                self.scope.lines += written
            values.append(value)
        return values

    def _is_fixed(self, value: Value) -> bool:
        """Return whether later statements of the same expression cannot change a value."""
        return value.known is not None or value.code.isidentifier() or value.code in self.scope.by_pointer.values()

    def scalar(self, node: ast.expr, kind: Scalar) -> str:
        """Return C of a number of one kind."""
        value = self.value(node)
        if not isinstance(value.type, Scalar) or (kind == INT and value.type == FLOAT):
            raise self.scope.fail(node, f"a number ({kind.name}) is needed here.")
        return self.scope.cast(value, kind)

    # Terms

    def _constant(self, node: ast.Constant) -> Value:
        if isinstance(node.value, bool):
            return Value("1" if node.value else "0", BOOL, node.value)
        if isinstance(node.value, int):
            return Value(f"{node.value}LL" if abs(node.value) > 2**31 - 1 else str(node.value), INT, node.value)
        if isinstance(node.value, float):
            return Value(repr(node.value), FLOAT, node.value)
        raise self.scope.fail(node, "only numbers are supported.")

    def _name(self, node: ast.Name) -> Value:
        kind = self.scope.variables.get(node.id)
        if kind is not None:
            return Value(self.scope.by_pointer.get(node.id, f"v_{node.id}"), kind)
        if node.id in self.constants:
            return self.value(self.constants[node.id])
        raise self.scope.fail(node, "this name is not defined, or not on every path to here.")

    def _attribute(self, node: ast.Attribute) -> Value:
        if isinstance(node.value, ast.Name) and node.value.id in ("np", "math") and node.attr in _CONSTANTS:
            return Value(_CONSTANTS[node.attr], FLOAT)
        base = self.value(node.value)
        if node.attr == "T" and base.type in (VECTOR, MATRIX):
            return base if base.type == VECTOR else Value(f"sn_turned({self.scope.argument(base)})", MATRIX)
        raise self.scope.fail(node, "this attribute is not supported.")

    def _tuple(self, node: ast.Tuple) -> Value:
        values = self.evaluate_all(node.elts)
        kind = Bundle(tuple(value.type for value in values))
        return Value(self.scope.make_tuple([value.code for value in values], kind), kind)

    # Operators

    def _unaryop(self, node: ast.UnaryOp) -> Value:
        value = self.value(node.operand)
        if isinstance(node.op, ast.Not):
            known = None if value.known is None else not value.known
            return Value(f"(!{self.truth(value, node)})", BOOL, known)
        if isinstance(node.op, ast.USub) and value.type == VECTOR:
            return self.allocate(f"sn_negative_v(w, {value.code})", VECTOR)
        if not isinstance(value.type, Scalar) or not isinstance(node.op, ast.USub):
            raise self.scope.fail(node, "this operator is not supported here.")
        kind = INT if value.type == BOOL else value.type
        return Value(f"(-{value.code})", kind, None if value.known is None else -value.known)

    def _binop(self, node: ast.BinOp) -> Value:
        if isinstance(node.op, ast.Pow):
            return self._power(node)
        left, right = self.evaluate_all([node.left, node.right])
        return self.binary(node, left, right)

    def binary(self, node: ast.AST, left: Value, right: Value) -> Value:
        """Return `left op right`; `node` holds the operator."""
        op: Any = type(node.op)  # type: ignore[attr-defined]
        if isinstance(left.type, View) or isinstance(right.type, View):
            if op not in _ARITHMETIC:
                raise self.scope.fail(node, "this operator is not supported between arrays.")
            return self.elementwise(node, f"sn_{_ARITHMETIC[op]}", left, right)
        if not (isinstance(left.type, Scalar) and isinstance(right.type, Scalar)):
            raise self.scope.fail(node, f"no arithmetic with {left.type} and {right.type}.")
        whole = FLOAT not in (left.type, right.type) and op is not ast.Div
        kind = INT if whole else FLOAT
        a, b = self.scope.cast(left, kind), self.scope.cast(right, kind)
        if op in (ast.Mod, ast.FloorDiv):
            return self._modulo(node, kind, a, b)
        if op not in _SIGNS:
            raise self.scope.fail(node, "this operator is not supported.")
        if whole and op is ast.Mult and not any(_small(v) for v in (left, right)):
            return Value(f"sn_times(w, {a}, {b})", INT)
        known = _fold(op, left, right) if whole else None
        return Value(f"({a} {_SIGNS[op]} {b})", kind, known)

    def _modulo(self, node: ast.AST, kind: Scalar, a: str, b: str) -> Value:
        if isinstance(node.op, ast.Mod):  # type: ignore[attr-defined]
            return Value(f"sn_modulo(w, {a}, {b})" if kind == INT else f"sn_fmod({a}, {b})", kind)
        if kind == INT:
            return Value(f"sn_floor_divide(w, {a}, {b})", INT)
        raise self.scope.fail(node, "`//` is supported between whole numbers only.")

    def elementwise(self, node: ast.AST, name: str, left: Value, right: Value) -> Value:
        """Return an elementwise operation on arrays of one shape, or on an array and a number."""
        letters = ""
        for value in (left, right):
            if value.type not in (VECTOR, MATRIX) and not isinstance(value.type, Scalar):
                raise self.scope.fail(node, f"no arithmetic with {value.type}.")
            letters += {VECTOR: "v", MATRIX: "m"}.get(value.type, "s")  # type: ignore[arg-type]
        if letters in ("vm", "mv"):
            raise self.scope.fail(node, "a vector and a matrix cannot have one shape.")
        a, b = (
            self.scope.cast(v, FLOAT) if isinstance(v.type, Scalar) else self.scope.argument(v) for v in (left, right)
        )
        return self.allocate(f"{name}_{letters}(w, {a}, {b})", MATRIX if "m" in letters else VECTOR)

    def _power(self, node: ast.BinOp) -> Value:
        base, exponent = self.evaluate_all([node.left, node.right])
        n = exponent.known
        if not isinstance(base.type, Scalar) or n is None:
            raise self.scope.fail(node, "powers are supported for numbers, with a constant exponent.")
        if int(n) != n or abs(n) > _LARGEST_POWER or base.type != FLOAT:
            raise self.scope.fail(node, "powers are supported of floats, for whole exponents up to 16.")
        return Value(f"sn_power_whole({base.code}, {int(n)})", FLOAT)

    # Truth

    def truth(self, value: Value, node: ast.AST) -> str:
        """Return C for the truth value of `value` in Python."""
        if value.type != BOOL:
            raise self.scope.fail(node, "only Booleans are true or false.")
        return value.code

    def _compare(self, node: ast.Compare) -> Value:
        values = self.evaluate_all([node.left, *node.comparators])
        values = [values[0], *(self.scope.store(v) for v in values[1:-1]), values[-1]]
        parts = []
        for op, left, right in zip(node.ops, values, values[1:], strict=False):
            if type(op) not in _COMPARISONS or not all(isinstance(v.type, Scalar) for v in (left, right)):
                raise self.scope.fail(node, "numbers are compared by < <= > >= == != only.")
            kind = FLOAT if FLOAT in (left.type, right.type) else INT
            parts.append(f"({self.scope.cast(left, kind)} {_COMPARISONS[type(op)]} {self.scope.cast(right, kind)})")
        return Value(parts[0] if len(parts) == 1 else "(" + " && ".join(parts) + ")", BOOL)

    def _boolop(self, node: ast.BoolOp) -> Value:
        sign = "&&" if isinstance(node.op, ast.And) else "||"
        result = self._booleans(node, node.values[0])
        for part in node.values[1:]:
            with self.scope.capture() as lines:
                value = self._booleans(node, part)
            if not lines:
                result = Value(f"({result.code} {sign} {value.code})", BOOL)
                continue
            name = self.scope.temporary(BOOL)
            self.scope.emit(f"{name} = {result.code};")
            self.scope.emit(f"if ({'' if sign == '&&' else '!'}{name}) {{")
            self.scope.lines += [*lines, f"{name} = {value.code};", "}"]
            result = Value(name, BOOL)
        return result

    def _booleans(self, node: ast.BoolOp, part: ast.expr) -> Value:
        value = self.value(part)
        if value.type != BOOL:
            raise self.scope.fail(node, "`and` and `or` are supported between Booleans only.")
        return value

    def _ifexp(self, node: ast.IfExp) -> Value:
        test = self.truth(self.value(node.test), node)
        with self.scope.capture() as yes_lines:
            yes = self.value(node.body)
        with self.scope.capture() as no_lines:
            no = self.value(node.orelse)
        kind = one_type(yes.type, no.type, self.scope.function)
        if not yes_lines and not no_lines and isinstance(kind, Scalar):
            return Value(f"({test} ? {yes.code} : {no.code})", kind)
        name = self.scope.temporary(kind)
        self.scope.emit(f"if ({test}) {{")
        self.scope.lines += yes_lines
        self.scope.emit(f"{name} = {yes.code};")
        self.scope.emit("} else {")
        self.scope.lines += no_lines
        self.scope.emit(f"{name} = {no.code};")
        self.scope.emit("}")
        return Value(name, kind)

    # Entries and parts

    def _subscript(self, node: ast.Subscript) -> Value:
        if isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
            return self._shape(node, node.value)
        base = self.value(node.value)
        if isinstance(base.type, Arrays):
            index = self.value(node.slice).known
            if not isinstance(index, int) or not 0 <= index < len(base.type.ranks):
                raise self.scope.fail(node, f"a constant below {len(base.type.ranks)} is needed here.")
            rank = base.type.ranks[index]
            return Value(f"{base.code}->arrays[{index}].v{rank}", View(rank))
        if isinstance(base.type, Bundle):
            return self._entry(node, base, base.type)
        if isinstance(base.type, View):
            return self.part(node, base, base.type)
        raise self.scope.fail(node, "this has no entries.")

    def _shape(self, node: ast.Subscript, attribute: ast.Attribute) -> Value:
        base, index = self.value(attribute.value), self.value(node.slice).known
        if not isinstance(base.type, View) or not isinstance(index, int) or not 0 <= index < base.type.rank:
            raise self.scope.fail(node, "this dimension is not there.")
        return Value(length(base.code, base.type, index), INT)

    def _entry(self, node: ast.Subscript, base: Value, kind: Bundle) -> Value:
        index = self.value(node.slice)
        if isinstance(index.known, int) and -len(kind.items) <= index.known < len(kind.items):
            i = index.known % len(kind.items)
            return Value(base.code + self.scope.types.field(kind, i), kind.items[i])
        if index.type != INT or not uniform(kind) or index.known is not None:
            raise self.scope.fail(node, "this entry of a tuple is not supported.")
        held = self.scope.store(base)
        place = self.scope.store(index)
        self.scope.emit(f"if ((uint64_t){place.code} >= {len(kind.items)}u) sn_outside(w);")
        return Value(f"{held.code}.f[{place.code}]", kind.items[0])

    def part(self, node: ast.Subscript, base: Value, kind: View) -> Value:
        """Return an entry, a row or a slice of an array."""
        places = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if len(places) > kind.rank:
            raise self.scope.fail(node, f"the array has {kind.rank} dimensions.")
        if not any(isinstance(place, ast.Slice) for place in places):
            return self._at(base, kind, places)
        if len(places) == 1 and isinstance(places[0], ast.Slice) and not kind.whole and kind.rank < 3:
            return self._slice_of(node, base, kind, places[0])
        if len(places) == 2 and kind == MATRIX:
            first, second = places
            if isinstance(second, ast.Slice) and not isinstance(first, ast.Slice):
                row = Value(f"sn_row2(w, {self.scope.place(base)}, {self.place(first)})", VECTOR)
                return row if _all(second) else self._slice_of(node, self.scope.store(row), VECTOR, second)
        raise self.scope.fail(node, "this part of an array is not supported.")

    def _at(self, base: Value, kind: View, places: list[ast.expr]) -> Value:
        if kind.whole:
            return Value(f"(*sn_at_i(w, {base.code}, {self.place(places[0])}))", INT)
        if len(places) == kind.rank:
            indices = ", ".join(self.place(place) for place in places)
            return Value(f"(*sn_at{kind.rank}(w, {self.scope.argument(base)}, {indices}))", FLOAT)
        rows = base
        for i, place in enumerate(places):
            rank = kind.rank - i
            rows = Value(f"sn_row{rank}(w, {self.scope.argument(rows)}, {self.place(place)})", View(rank - 1))
        return rows

    def place(self, node: ast.expr) -> str:
        """Return C of an index."""
        index = self.value(node)
        if index.type != INT or (index.known is not None and index.known < 0):
            raise self.scope.fail(node, "an index must be a whole number, counted from the start.")
        return index.code

    def _slice_of(self, node: ast.AST, base: Value, kind: View, cut: ast.Slice) -> Value:
        if cut.step is not None:
            raise self.scope.fail(node, "a slice with a step is not supported.")
        if _all(cut):
            return base
        if not base.code.isidentifier():
            base = self.scope.store(base)
        low = "0" if cut.lower is None else self.place(cut.lower)
        high = length(base.code, kind, 0) if cut.upper is None else self.place(cut.upper)
        return Value(f"sn_cut{'2' if kind.rank == 2 else ''}(w, {self.scope.argument(base)}, {low}, {high})", kind)

    # Calls

    def _call(self, node: ast.Call) -> Value:
        function = node.func
        if isinstance(function, ast.Attribute):
            if isinstance(function.value, ast.Name) and function.value.id in ("np", "math"):
                if function.attr == "array":
                    return array_of(self, node)
                return numpy_call(self, node, function.attr, self.evaluate_all(node.args))
            return method(self, node, function.attr, self.value(function.value))
        if not isinstance(function, ast.Name):
            raise self.scope.fail(node, "this call is not supported.")
        result = self._own(node, self)
        return plain_call(self, node, function.id) if result is None else result

    def allocate(self, code: str, kind: Type) -> Value:
        """Return a new array in a new variable, so that it is made once and in order."""
        self.scope.allocates = True
        return self.scope.store(Value(code, kind))


def _all(cut: ast.Slice) -> bool:
    return cut.lower is None and cut.upper is None and cut.step is None


def _small(value: Value) -> bool:
    return value.known is not None and abs(value.known) <= _SMALL_FACTOR


def _fold(op: Any, left: Value, right: Value) -> int | None:
    if left.known is None or right.known is None:
        return None
    a, b = int(left.known), int(right.known)
    return {ast.Add: a + b, ast.Sub: a - b, ast.Mult: a * b}.get(op)
