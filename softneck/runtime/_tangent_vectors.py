"""Derivatives of whole vectors in rows: what each of their entries is moved by, in loops of their own."""

from __future__ import annotations

import ast

from ._tangent_activity import MAKERS, is_numpy, viewed
from ._tangent_lowering import Lowering, Terms, inner


class Vectors(Lowering):
    """Writes assignments of vectors."""

    _whole: ast.expr | None
    _waiting: list[str]
    _loops: list[list[str]]
    _stored: set[str]

    def _array(self, node: ast.stmt, target: ast.expr, value: ast.expr) -> None:
        act, said = self.activity, ast.unparse(node)
        if (hoisted := self._hoisted(value)) is not value:
            value, said = hoisted, f"{ast.unparse(target)} = {ast.unparse(hoisted)}"
        if isinstance(target, ast.Name) and not isinstance(node, ast.AugAssign):
            self._flush()
            self.lines.append(said)
            if is_numpy(value, *MAKERS) and isinstance(value, ast.Call):
                self.lines.append(f"{target.id}_rows = {made_rows(value)}")
            elif is_numpy(value, "sort") and isinstance(value, ast.Call):
                self._sorted(target.id, value.args[0])
            elif viewed(value) is not None or is_copy(value):
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
        rows, first, count = self._stretch(target)
        first, count = self.kept(first, "i"), self.kept(count, "i")
        if act.rank(value) == 0:  # a number for all entries
            text, terms = self.value(value)
            text, one = self.kept(text), self.name("d")
            self._stored.add(one)
            self.lines += ["for _r in range(moved):", f"    «{one}» = {linear(terms)}"]
            self.lines += [*loops(count, f"{rows}[{first} + _i, _r] = «{one}»"), f"{ast.unparse(target)} = {text}"]
            return
        source = value.func.value if is_copy(value) else value  # type: ignore[union-attr]
        base = viewed(source)
        same = base is not None and act.root(base.id) == act.root(getattr(viewed(target), "id", ""))
        if same and isinstance(source, ast.Subscript | ast.Name):
            other, start, _ = self._stretch(source)
            if other != rows:
                raise self.fail(node, "parts of one array are shifted under one name.")
            self.lines.append(f"tangent_shifted({rows}, {first}, {start}, {count}, moved)")
        elif any(act.root(n.id) == act.root(getattr(viewed(target), "id", "")) for n in names(value)):
            aside = self.name("w")
            self.lines.append(f"{aside} = np.empty(({count}, moved))")
            self._fill(node, aside, "0", count, value)
            self.lines += loops(count, f"{rows}[{first} + _i, _r] = {aside}[_i, _r]")
        else:
            self._fill(node, rows, first, count, value)
        self.lines.append(said)

    def _hoisted(self, node: ast.expr) -> ast.expr:
        """Return an expression with names for the vectors that calls and products in it make, written before it."""
        act = self.activity
        if isinstance(node, ast.Call) and act.is_active(node) and act.rank(node) == 1:
            name = act.program.called(node)
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
            left, right = self._hoisted(node.left), self._hoisted(node.right)
            return node if (left, right) == (node.left, node.right) else ast.BinOp(left, node.op, right)
        if isinstance(node, ast.UnaryOp):
            operand = self._hoisted(node.operand)
            return node if operand is node.operand else ast.UnaryOp(node.op, operand)
        if isinstance(node, ast.Subscript):
            value = self._hoisted(node.value)
            return node if value is node.value else ast.Subscript(value, node.slice, ast.Load())
        return node

    def _product(self, node: ast.Call) -> str:
        """Write a matrix that nothing moves times a vector, and return its name."""
        matrix, vector = node.args[0], self._named(self._hoisted(node.args[1]))
        rows, first, _ = self._stretch(vector)
        made = self.name("v")
        self.lines.append(f"{made} = np.dot({ast.unparse(matrix)}, {ast.unparse(vector)})")
        self.lines.append(f"{made}_rows = tangent_product({ast.unparse(matrix)}, {rows}, {first}, moved)")
        return made

    def _named(self, vector: ast.expr) -> ast.Name | ast.Subscript:
        """Return a vector under a name of its own, or where it stands already."""
        if isinstance(vector, ast.Name | ast.Subscript):
            return vector
        aside = self.name("v")
        self._flush()
        self.lines += [f"{aside} = {ast.unparse(vector)}", f"{aside}_rows = np.empty(({aside}.shape[0], moved))"]
        self._fill(ast.Expr(vector), f"{aside}_rows", "0", f"{aside}.shape[0]", vector)
        return ast.Name(aside, ast.Load())

    def _sorted(self, name: str, value: ast.expr) -> None:
        """Write the rows of a sorted vector: those of its entries, in their new order."""
        order = self.name("o")
        self.lines += [f"{order} = np.argsort({ast.unparse(value)})"]
        self.lines += [f"{name}_rows = np.empty(({name}.shape[0], moved))"]
        self.lines += loops(f"{name}.shape[0]", f"{name}_rows[_i, _r] = {self._rows(value)}[{order}[_i], _r]")

    def _fill(self, node: ast.stmt, rows: str, first: str, count: str, value: ast.expr) -> None:
        """Write the loops that fill rows with what a vector is moved by."""
        terms = self._vector(node, value)
        self.lines += loops(count, f"{rows}[{first} + _i, _r] = {linear(terms)}")

    def _vector(self, node: ast.stmt, value: ast.expr) -> Terms:
        """Return the terms of entry `_i` of a vector."""
        act = self.activity
        if not act.is_active(value):
            return []
        if is_copy(value):
            return self._vector(node, value.func.value)  # type: ignore[union-attr]
        if isinstance(value, ast.Name | ast.Subscript):
            rows, start, _ = self._stretch(value)
            return [("1.0", f"{rows}[{self.kept(start, 'i')} + _i, _r]")]
        if isinstance(value, ast.UnaryOp) and isinstance(value.op, ast.USub):
            return self.times(self._vector(node, value.operand), "-1.0")
        if isinstance(value, ast.BinOp) and isinstance(value.op, ast.Add | ast.Sub):
            right = self._vector(node, value.right)
            right = self.times(right, "-1.0") if isinstance(value.op, ast.Sub) else right
            return self.sum(self._vector(node, value.left), right)
        if isinstance(value, ast.BinOp) and isinstance(value.op, ast.Mult | ast.Div):
            left, right = value.left, value.right
            if act.is_active(right) and isinstance(value.op, ast.Mult):
                left, right = right, left
            if act.rank(right) == 0 and not act.is_active(right):
                factor = self.kept(ast.unparse(right))
                return self.times(
                    self._vector(node, left), factor if isinstance(value.op, ast.Mult) else f"1.0 / {factor}"
                )
            if act.rank(right) != 0 and not act.is_active(right) and isinstance(right, ast.Name | ast.Subscript):
                sign = "*" if isinstance(value.op, ast.Mult) else "/"  # entry by entry
                return [(one, f"{place} {sign} {ast.unparse(right)}[_i]") for one, place in self._vector(node, left)]
        raise self.fail(node, "the derivative of this array is not known.")

    def _rows(self, node: ast.expr) -> str:
        """Return the rows of an array or of a part of it."""
        if isinstance(node, ast.Name):
            return f"{node.id}_rows"
        if isinstance(node, ast.Subscript):
            return f"{self._rows(node.value)}[{ast.unparse(node.slice)}]"
        raise self.fail(node, "what this is moved by stands nowhere.")

    def _stretch(self, node: ast.expr) -> tuple[str, str, str]:
        """Return the rows that a vector is a part of, where it begins there, and its length."""
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
    """Return the rows of a new array."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
    shape = node.args[0]
    sizes = list(map(ast.unparse, shape.elts)) if isinstance(shape, ast.Tuple) else [ast.unparse(shape)]
    if name.endswith("_like"):
        sizes = [f"{sizes[0]}.shape[0]"]
    return f"np.{'empty' if name.startswith('empty') else 'zeros'}(({', '.join([*sizes, 'moved'])}))"
