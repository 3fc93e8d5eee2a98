"""Differentiation of expressions: the value and its tangent, linear in the tangents of its variables.

The terms of a derivative are `partial * place`, where `place` is the tangent (or adjoint) of a variable. Partials are
computed together with the value and bound to new names, so that later statements may overwrite their operands. The
tangents of vectors are computed in loops over their entries.
"""

from __future__ import annotations

import ast
import re
from typing import Any

from ._tangent_activity import MAKERS, Activity, is_numpy, viewed_name

Terms = list[tuple[str, str]]
_KEPT = re.compile(r"_[a-z]\d+|-?\d+(\.\d*)?(e-?\d+)?")
_SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
# Derivatives of f(x), with v for f(x). That of a root of zero is set to 0: it has no finite slope.
_SLOPES = {
    "sin": "math.cos({x})", "cos": "-math.sin({x})", "tan": "1.0 + {v} * {v}", "tanh": "1.0 - {v} * {v}",
    "exp": "{v}", "log": "1.0 / {x}", "sqrt": "0.5 / {v} if {v} > 0.0 else 0.0", "atan": "1.0 / (1.0 + {x} * {x})",
}  # fmt: skip
# A length below 1e-12 is rounding and has no direction; this is its square.
_NO_LENGTH = 1e-24


class Lowering:
    """Generator of the lines of one derived function; `lines` are without indentation.

    Forward and reverse mode differ in their places and calls.
    """

    def __init__(self, activity: Activity) -> None:
        """Begin with no lines."""
        self.activity = activity
        self.lines: list[str] = []
        self._count = 0

    def place(self, node: ast.Name | ast.Subscript) -> str:
        """Return the tangent or adjoint of a number."""
        raise NotImplementedError

    def call(self, node: ast.Call, name: str) -> tuple[str, Terms]:
        """Return value and derivative of a call of one of the text's own functions."""
        raise NotImplementedError

    def product(self, node: ast.Call) -> tuple[str, Terms]:
        """Return value and derivative of an `np.dot` that is a number."""
        raise self.fail(node, "there is no derivative of this here.")

    def fail(self, node: ast.AST, text: str) -> Exception:
        """Return the error that names function and line."""
        return self.activity.fail(node, text)

    def name(self, letter: str) -> str:
        """Return a new name."""
        self._count += 1
        return f"_{letter}{self._count}"

    def bind(self, text: str, letter: str = "v") -> str:
        """Assign a number to a new name and return that name; names and constants stay as they are."""
        if _KEPT.fullmatch(text):
            return text
        name = self.name(letter)
        self.lines.append(f"{name} = {text}")
        return name

    def value(self, node: ast.expr) -> tuple[str, Terms]:
        """Return an expression's text, and the terms of its derivative."""
        if not self.activity.is_active(node):
            return f"({ast.unparse(node)})" if not isinstance(node, ast.Name | ast.Constant) else ast.unparse(node), []
        handler: Any = getattr(self, f"_{type(node).__name__.lower()}", None)
        if handler is None or self.activity.rank(node) not in (0, None):
            raise self.fail(node, "there is no derivative of this here.")
        return handler(node)

    def times(self, terms: Terms, factor: str) -> Terms:
        """Return `terms` multiplied by a number."""
        if not terms or factor == "1.0":
            return terms
        factor = self.bind(factor, "p")
        scaled = []
        for partial, place in terms:
            one = factor if partial == "1.0" else self.bind(f"{partial} * {factor}", "p")
            scaled.append((one, place))
        return scaled

    def sum(self, first: Terms, second: Terms) -> Terms:
        """Return the sum of both, each place once."""
        found = {place: partial for partial, place in first}
        for partial, place in second:
            found[place] = self.bind(f"{found[place]} + {partial}", "p") if place in found else partial
        return [(partial, place) for place, partial in found.items()]

    def index(self, node: ast.Subscript) -> str:
        """Return the indices of an entry, bound to names."""
        places = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        return ", ".join(self.bind(ast.unparse(place), "i") for place in places)

    # Terms

    def _name(self, node: ast.Name) -> tuple[str, Terms]:
        return node.id, [("1.0", self.place(node))]

    def _subscript(self, node: ast.Subscript) -> tuple[str, Terms]:
        return ast.unparse(node), [("1.0", self.place(node))]

    def _unaryop(self, node: ast.UnaryOp) -> tuple[str, Terms]:
        text, terms = self.value(node.operand)
        if not isinstance(node.op, ast.USub):
            raise self.fail(node, "this operator has no derivative.")
        return f"(-{text})", self.times(terms, "-1.0")

    def _binop(self, node: ast.BinOp) -> tuple[str, Terms]:
        if isinstance(node.op, ast.Pow):
            return self._power(node)
        (a, first), (b, second) = self.value(node.left), self.value(node.right)
        sign = _SIGNS.get(type(node.op))
        if sign is None:
            raise self.fail(node, "this operator has no derivative.")
        if sign in "+-":
            return f"({a} {sign} {b})", self.sum(first, second if sign == "+" else self.times(second, "-1.0"))
        if sign == "*":
            a = self.bind(a) if second else a
            b = self.bind(b) if first else b
            return f"({a} * {b})", self.sum(self.times(first, b), self.times(second, a))
        b = self.bind(b)
        value = self.bind(f"{a} / {b}")
        return value, self.sum(self.times(first, f"1.0 / {b}"), self.times(second, f"-{value} / {b}"))

    def _power(self, node: ast.BinOp) -> tuple[str, Terms]:
        n = node.right.value if isinstance(node.right, ast.Constant) else None
        if not isinstance(n, int | float):
            raise self.fail(node, "powers are differentiated with a constant exponent.")
        text, terms = self.value(node.left)
        text = self.bind(text)
        slope = f"{n} * {text}" if n == 2 else f"{n} * {text} ** {n - 1}"
        return f"({text} ** {n})", self.times(terms, slope)

    def _ifexp(self, node: ast.IfExp) -> tuple[str, Terms]:
        value, outside = self.name("y"), self.lines
        found: list[tuple[str, str]] = []
        written: list[list[str]] = []
        for branch in (node.body, node.orelse):
            self.lines = []
            text, terms = self.value(branch)
            self.lines.append(f"{value} = {text}")
            for partial, place in terms:
                name = self.name("p")
                self.lines.append(f"{name} = {partial}")
                found.append((name, place))
            written.append(self.lines)
        self.lines = outside + zero_undefined(written, {value})
        self.lines += [f"if {ast.unparse(node.test)}:", *inner(written[0]), "else:", *inner(written[1])]
        terms: Terms = []
        for term in found:
            terms = self.sum(terms, [term])
        return value, terms

    def _call(self, node: ast.Call) -> tuple[str, Terms]:
        own = self.activity.program.callee_name(node)
        if own is not None:
            return self.call(node, own)
        function = node.func
        name = function.attr if is_numpy(node) else getattr(function, "id", "")  # type: ignore[attr-defined]
        if node.keywords:
            raise self.fail(node, "keyword arguments are not differentiated.")
        if name == "dot":
            return self.product(node)
        if name in ("max", "min") and len(node.args) > 1:
            return self._extreme(node, 1 if name == "max" else -1)
        if name == "atan2":
            return self._atan2(node)
        if len(node.args) != 1 or name not in (*_SLOPES, "float", "abs"):
            raise self.fail(node, "the derivative of this function is not known.")
        if name == "sqrt" and (parts := squares(node.args[0])):
            return self._root(node, parts)
        text, terms = self.value(node.args[0])
        if name == "float":
            return f"float({text})", terms
        text = self.bind(text)
        if name == "abs":
            return f"abs({text})", self._select(1, (text, terms), (f"-{text}", self.times(terms, "-1.0")))
        value = self.bind(f"{ast.unparse(function)}({text})")
        return value, self.times(terms, _SLOPES[name].format(x=text, v=value))

    def _extreme(self, node: ast.Call, sign: int) -> tuple[str, Terms]:
        function = ast.unparse(node.func)
        value, terms = self.value(node.args[0])
        for other in node.args[1:]:
            text, more = self.value(other)
            value, text = self.bind(value), self.bind(text)
            terms = self._select(sign, (value, terms), (text, more))
            value = f"{function}({value}, {text})"
        return value, terms

    def _atan2(self, node: ast.Call) -> tuple[str, Terms]:
        parts = [self.value(part) for part in node.args]
        (a, first), (b, second) = ((self.bind(text), terms) for text, terms in parts)
        value = self.bind(f"{ast.unparse(node.func)}({a}, {b})")
        square = self.bind(f"{a} * {a} + {b} * {b}")
        return value, self.sum(self.times(first, f"{b} / {square}"), self.times(second, f"-{a} / {square}"))

    def _root(self, node: ast.Call, nodes: list[ast.expr]) -> tuple[str, Terms]:
        parts = [self.value(part) for part in nodes]
        parts = [(self.bind(text), terms) for text, terms in parts]
        total = " + ".join(f"{text} * {text}" for text, _ in parts)
        value = self.bind(f"{ast.unparse(node.func)}({total})")
        return value, self._length(value, parts)

    def _select(self, sign: int, a: tuple[str, Terms], b: tuple[str, Terms]) -> Terms:
        """Return the derivative of the larger (sign 1) or smaller (-1) of two; if equal, the first counts as larger."""
        first = self.bind(f"1.0 if {a[0]} {'>=' if sign > 0 else '<'} {b[0]} else 0.0", "p")
        return self.sum(self.times(a[1], first), self.times(b[1], f"1.0 - {first}"))

    def _length(self, value: str, parts: list[tuple[str, Terms]]) -> Terms:
        """Return the derivative of the length `value` of a vector; at zero that of its first component."""
        over = self.bind(f"1.0 / math.sqrt({value} * {value} + {_NO_LENGTH})", "p")
        terms: Terms = []
        for number, (text, more) in enumerate(parts):
            slope = f"{text} * {over}"
            terms = self.sum(terms, self.times(more, slope if number else f"{slope} if {value} > 0.0 else 1.0"))
        return terms


def squares(node: ast.expr) -> list[ast.expr]:
    """Return a, b, ... of `a * a + b * b + ...`, whose root is a length; empty for other expressions."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        first, second = squares(node.left), squares(node.right)
        return first + second if first and second else []
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult) and ast.dump(node.left) == ast.dump(node.right):
        return [node.left]
    return []


def inner(lines: list[str]) -> list[str]:
    """Return lines with one more level of indentation."""
    return ["    " + line for line in lines]


def zero_undefined(branches: list[list[str]], others: set[str] | None = None) -> list[str]:
    """Return lines that set the names of all branches to zero: compilers require every name to be set."""
    names = dict.fromkeys(sorted(others or ()))
    for line in (line for branch in branches for line in branch):
        found = re.match(r"\s*(_[a-z]\d+) = ", line)
        if found:
            names[found[1]] = None
    return [f"{name} = {'0' if name.startswith('_i') else '0.0'}" for name in names if not name.startswith("_g")]


class Vectors(Lowering):
    """Generator of assignments of vectors."""

    _whole: ast.expr | None
    _waiting: list[str]
    _loops: list[list[str]]
    _stored: set[str]

    def _array(self, node: ast.stmt, target: ast.expr, value: ast.expr) -> None:
        act, said = self.activity, ast.unparse(node)
        if (hoisted := self._hoist(value)) is not value:
            value, said = hoisted, f"{ast.unparse(target)} = {ast.unparse(hoisted)}"
        if isinstance(target, ast.Name) and not isinstance(node, ast.AugAssign):
            self._flush()
            self.lines.append(said)
            if is_numpy(value, *MAKERS) and isinstance(value, ast.Call):
                self.lines.append(f"{target.id}_rows = {made_rows(value)}")
            elif is_numpy(value, "sort") and isinstance(value, ast.Call):
                self._sort_rows(target.id, value.args[0])
            elif viewed_name(value) is not None or is_copy(value):
                copied = is_copy(value) and isinstance(value, ast.Call)
                base = value.func.value if copied and isinstance(value.func, ast.Attribute) else value  # type: ignore[union-attr]
                self.lines.append(f"{target.id}_rows = {self._rows(base)}{'.copy()' if copied else ''}")
            else:
                rows = f"{target.id}_rows"
                self.lines.append(f"{rows} = np.empty(({target.id}.shape[0], moved))")
                self._fill(node, rows, "0", f"{target.id}.shape[0]", value)
            return
        if act.rank(target) != 1:
            raise self.fail(node, "the derivative of whole matrices is not known.")
        self._flush()
        rows, first, count = self._part_of_rows(target)
        first, count = self.bind(first, "i"), self.bind(count, "i")
        if act.rank(value) == 0:  # a number for all entries
            text, terms = self.value(value)
            text, one = self.bind(text), self.name("d")
            self._stored.add(one)
            self.lines += ["for _r in range(moved):", f"    «{one}» = {linear(terms)}"]
            self.lines += [*loops(count, f"{rows}[{first} + _i, _r] = «{one}»"), f"{ast.unparse(target)} = {text}"]
            return
        source = value.func.value if is_copy(value) else value  # type: ignore[union-attr]
        base = viewed_name(source)
        same = base is not None and act.root(base.id) == act.root(getattr(viewed_name(target), "id", ""))
        if same and isinstance(source, ast.Subscript | ast.Name):
            other, start, _ = self._part_of_rows(source)
            if other != rows:
                raise self.fail(node, "parts of one array are shifted under one name.")
            self.lines.append(f"tangent_shifted({rows}, {first}, {start}, {count}, moved)")
        elif any(act.root(n.id) == act.root(getattr(viewed_name(target), "id", "")) for n in names(value)):
            aside = self.name("w")
            self.lines.append(f"{aside} = np.empty(({count}, moved))")
            self._fill(node, aside, "0", count, value)
            self.lines += loops(count, f"{rows}[{first} + _i, _r] = {aside}[_i, _r]")
        else:
            self._fill(node, rows, first, count, value)
        self.lines.append(said)

    def _hoist(self, node: ast.expr) -> ast.expr:
        """Write the calls and products that make vectors ahead of an expression; return it with their names."""
        act = self.activity
        if isinstance(node, ast.Call) and act.is_active(node) and act.rank(node) == 1:
            name = act.program.callee_name(node)
            if name is None and (not is_numpy(node, "dot") or act.is_active(node.args[0])):
                return node
            self._flush()
            if name is not None:
                self._whole = node
            made = self._product(node) if name is None else self.call(node, name)[0]
            act.ranks[made] = 1
            act.active.add(made)
            return ast.Name(made, ast.Load())
        if isinstance(node, ast.BinOp):
            left, right = self._hoist(node.left), self._hoist(node.right)
            return node if (left, right) == (node.left, node.right) else ast.BinOp(left, node.op, right)
        if isinstance(node, ast.UnaryOp):
            operand = self._hoist(node.operand)
            return node if operand is node.operand else ast.UnaryOp(node.op, operand)
        if isinstance(node, ast.Subscript):
            value = self._hoist(node.value)
            return node if value is node.value else ast.Subscript(value, node.slice, ast.Load())
        return node

    def _product(self, node: ast.Call) -> str:
        """Write the product of a constant matrix and a vector, and return its name."""
        matrix, vector = node.args[0], self._bind_vector(self._hoist(node.args[1]))
        rows, first, _ = self._part_of_rows(vector)
        made = self.name("v")
        self.lines.append(f"{made} = np.dot({ast.unparse(matrix)}, {ast.unparse(vector)})")
        self.lines.append(f"{made}_rows = tangent_product({ast.unparse(matrix)}, {rows}, {first}, moved)")
        return made

    def _bind_vector(self, vector: ast.expr) -> ast.Name | ast.Subscript:
        """Assign a vector to a new name and return that name; names and parts of arrays stay as they are."""
        if isinstance(vector, ast.Name | ast.Subscript):
            return vector
        aside = self.name("v")
        self._flush()
        self.lines += [f"{aside} = {ast.unparse(vector)}", f"{aside}_rows = np.empty(({aside}.shape[0], moved))"]
        self._fill(ast.Expr(vector), f"{aside}_rows", "0", f"{aside}.shape[0]", vector)
        return ast.Name(aside, ast.Load())

    def _sort_rows(self, name: str, value: ast.expr) -> None:
        """Write the rows of a sorted vector: those of its entries, in their new order."""
        order = self.name("o")
        self.lines += [f"{order} = np.argsort({ast.unparse(value)})"]
        self.lines += [f"{name}_rows = np.empty(({name}.shape[0], moved))"]
        self.lines += loops(f"{name}.shape[0]", f"{name}_rows[_i, _r] = {self._rows(value)}[{order}[_i], _r]")

    def _fill(self, node: ast.stmt, rows: str, first: str, count: str, value: ast.expr) -> None:
        """Write the loops that fill rows with the tangents of a vector."""
        terms = self._vector(node, value)
        self.lines += loops(count, f"{rows}[{first} + _i, _r] = {linear(terms)}")

    def _vector(self, node: ast.stmt, value: ast.expr) -> Terms:
        """Return the terms of the derivative of entry `_i` of a vector."""
        act = self.activity
        if not act.is_active(value):
            return []
        if isinstance(value, ast.Name | ast.Subscript):
            rows, start, _ = self._part_of_rows(value)
            return [("1.0", f"{rows}[{self.bind(start, 'i')} + _i, _r]")]
        if isinstance(value, ast.UnaryOp) and isinstance(value.op, ast.USub):
            return self.times(self._vector(node, value.operand), "-1.0")
        if isinstance(value, ast.BinOp) and isinstance(value.op, ast.Add | ast.Sub):
            right = self._vector(node, value.right)
            right = self.times(right, "-1.0") if isinstance(value.op, ast.Sub) else right
            return self.sum(self._vector(node, value.left), right)
        if isinstance(value, ast.BinOp) and isinstance(value.op, ast.Mult | ast.Div):
            left, right = value.left, value.right
            if act.rank(right) != 0 and not act.is_active(right) and isinstance(right, ast.Name | ast.Subscript):
                sign = "*" if isinstance(value.op, ast.Mult) else "/"  # entry by entry
                return [(one, f"{place} {sign} {ast.unparse(right)}[_i]") for one, place in self._vector(node, left)]
        raise self.fail(node, "the derivative of this array is not known.")

    def _rows(self, node: ast.expr) -> str:
        """Return the tangents of an array or of a part of it."""
        if isinstance(node, ast.Name):
            return f"{node.id}_rows"
        if isinstance(node, ast.Subscript):
            return f"{self._rows(node.value)}[{ast.unparse(node.slice)}]"
        raise self.fail(node, "this expression has no tangents.")

    def _part_of_rows(self, node: ast.expr) -> tuple[str, str, str]:
        """Return the tangents of the array that contains a vector, the vector's start index, and its length."""
        if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Slice) and node.slice.step is None:
            low = ast.unparse(node.slice.lower) if node.slice.lower is not None else "0"
            high = f"{ast.unparse(node.value)}.shape[0]" if node.slice.upper is None else ast.unparse(node.slice.upper)
            return self._rows(node.value), low, high if low == "0" else f"{high} - ({low})"
        return self._rows(node), "0", f"{ast.unparse(node)}.shape[0]"

    def _flush(self) -> None:
        if self._waiting:
            self._loops.append(self._waiting)
            self.lines += ["for _r in range(moved):", *inner(self._waiting)]
            self._waiting = []


def linear(terms: Terms) -> str:
    """Return the sum of terms."""
    shown = [{"1.0": place, "-1.0": f"-{place}"}.get(partial, f"{partial} * {place}") for partial, place in terms]
    return " + ".join(shown) or "0.0"


def loops(count: str, line: str) -> list[str]:
    """Return the loops over the entries of a vector and over directions."""
    return [f"for _i in range({count}):", "    for _r in range(moved):", f"        {line}"]


def is_copy(node: ast.expr) -> bool:
    """Return whether `node` is `array.copy()`."""
    function = node.func if isinstance(node, ast.Call) else None
    return isinstance(function, ast.Attribute) and function.attr == "copy" and not is_numpy(node)


def names(node: ast.expr) -> list[ast.Name]:
    """Return the names in an expression."""
    return [part for part in ast.walk(node) if isinstance(part, ast.Name)]


def made_rows(node: ast.Call) -> str:
    """Return the tangents of a new array."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
    shape = node.args[0]
    sizes = list(map(ast.unparse, shape.elts)) if isinstance(shape, ast.Tuple) else [ast.unparse(shape)]
    return f"np.{name}(({', '.join([*sizes, 'moved'])}))"
