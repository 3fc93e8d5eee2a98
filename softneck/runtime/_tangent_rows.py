"""Derivatives in rows: a function of the text that carries, beside each number, what every direction moves it by.

All lines between two calls, loops or branches that move numbers stand in one loop over the directions, behind the lines
that compute. Numbers used in one such loop alone need no memory there.
"""

from __future__ import annotations

import ast
import re
from typing import Protocol

from ._tangent_activity import MAKERS, Activity, Pattern, is_numpy, pairs, viewed
from ._tangent_lowering import Lowering, Terms, inner

_PLACE = re.compile(r"«(\w+)»")
_ROW = re.compile(r"<(\w+)>")


class Derived(Protocol):
    """What knows the other derived functions."""

    def rows(self, name: str, pattern: Pattern) -> str:
        """Return the name of a function's derivative in rows."""
        ...

    def back(self, name: str, pattern: Pattern) -> str | None:
        """Return the name of a function's derivative in reverse; None where rows do better."""
        ...


class Rows(Lowering):
    """Writes the derivative in rows of one function."""

    def __init__(self, activity: Activity, derived: Derived) -> None:
        """Begin."""
        super().__init__(activity)
        self._derived = derived
        self._waiting: list[str] = []
        self._loops: list[list[str]] = []
        self._stored: set[str] = set()
        self._whole: ast.expr | None = None
        assigned = {n.id for n in ast.walk(activity.node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        self._given = {name for name, rank in activity.written.items() if rank == 0 and name not in assigned}
        self._taken = {name for name, rank in activity.written.items() if rank == 0 and name in assigned}

    def text(self, name: str) -> str:
        """Return the derived function, called `name`."""
        act = self.activity
        for parameter in sorted(self._taken):
            self._waiting.append(f"«{parameter}» = {parameter}_rows[_r]")
        self._block(act.node.body)
        self._flush()
        kept = self._rows_of_numbers()
        arguments = [*act.parameters, *(f"{p}_rows" for p in act.written), *(["result_rows"] if act.result else [])]
        head = [f"def {name}({', '.join([*arguments, 'moved'])}):"]
        own = [f"_own = np.empty(({len(kept)}, moved))"] if kept else []
        body = []
        for line in self.lines:
            line = _PLACE.sub(lambda m: f"_own[{kept[m[1]]}, _r]" if m[1] in kept else f"_d_{m[1]}", line)
            body.append(_ROW.sub(lambda m: f"_own[{kept[m[1]]}]", line))
        return "\n".join(head + inner(own + without_unused(body))) + "\n"

    def _rows_of_numbers(self) -> dict[str, int]:
        """Return the numbers whose rows are kept between loops, each with its place."""
        seen: dict[str, int] = {}
        for number, lines in enumerate(self._loops):
            for line in lines:
                target, _, value = line.partition(" = ")
                for name in _PLACE.findall(value):
                    if seen.get(name) != number:
                        self._stored.add(name)
                for name in _PLACE.findall(target):
                    if seen.setdefault(name, number) != number:
                        self._stored.add(name)
        return {name: i for i, name in enumerate(sorted(self._stored))}

    # Statements

    def _block(self, body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.For | ast.While | ast.If):
                self._compound(node)
            elif isinstance(node, ast.Assign | ast.AugAssign):
                self._assign(node)
            elif isinstance(node, ast.Return):
                self._return(node)
            elif isinstance(node, ast.Expr):
                self._expression(node)
            elif isinstance(node, ast.Pass | ast.Break | ast.Continue | ast.Raise):
                self._flush()
                self.lines.append(ast.unparse(node))
            else:
                raise self.fail(node, "the derivative of this statement is not known.")

    def _compound(self, node: ast.For | ast.While | ast.If) -> None:
        self._flush()
        head = ast.unparse(node).splitlines()[0]
        if not isinstance(node, ast.If) and node.orelse:
            raise self.fail(node, "`else` of a loop is not differentiated.")
        outside = self.lines
        for start, body in ((head, node.body), ("else:", node.orelse)):
            if body:
                self.lines = []
                self._block(body)
                self._flush()
                outside += [start, *inner(self.lines or ["pass"])]
        self.lines = outside

    def _expression(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        name = self.activity.program.called(node.value)
        if name is not None and isinstance(node.value, ast.Call) and self.activity.pattern(node.value, name):
            self._whole = node.value
            self.call(node.value, name)
        else:
            self.lines.append(ast.unparse(node))

    def _return(self, node: ast.Return) -> None:
        if self.activity.result and node.value is not None:
            self._whole = node.value
            text, terms = self.value(node.value)
            text = self.kept(text)
            self._waiting.append(f"result_rows[_r] = {linear(terms)}")
            self._flush()
            self.lines.append(f"return {text}")
        else:
            self._flush()
            self.lines.append(ast.unparse(node))

    def _assign(self, node: ast.Assign | ast.AugAssign) -> None:
        act = self.activity
        one: list[tuple[ast.expr, ast.expr | None]]
        if isinstance(node, ast.AugAssign):
            before = ast.parse(ast.unparse(node.target), mode="eval").body
            one = [(node.target, ast.BinOp(before, node.op, node.value))]
        else:
            one = [pair for target in node.targets for pair in pairs(target, node.value)]
        if not any(act.is_active(target) for target, _ in one):
            self.lines.append(ast.unparse(node))
            return
        if isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add | ast.Sub) and not act.is_active(node.value):
            self.lines.append(ast.unparse(node))
            return
        if len(one) > 1:
            self._several(node, one)
            return
        target, value = one[0]
        if value is None:
            raise self.fail(node, "the derivative of several results of a call is not known.")
        self._whole = value
        if act.rank(target) == 0:
            self._number(target, *self.value(value))
        else:
            self._array(node, target, value)

    def _several(self, node: ast.stmt, one: list[tuple[ast.expr, ast.expr | None]]) -> None:
        """Assign several numbers at once: all values before any target."""
        values = []
        for target, value in one:
            if value is None or self.activity.rank(target) != 0:
                raise self.fail(node, "the derivative of this assignment is not known.")
            text, terms = self.value(value)
            moved = self.name("d")
            self._waiting.append(f"«{moved}» = {linear(terms)}")
            values.append((target, self.kept(text), [("1.0", f"«{moved}»")]))
        for target, text, terms in values:
            self._number(target, text, terms)

    def _number(self, target: ast.expr, text: str, terms: Terms) -> None:
        if self.activity.is_active(target) and isinstance(target, ast.Name | ast.Subscript):
            self._waiting.append(f"{self.place(target)} = {linear(terms)}")
        self.lines.append(f"{ast.unparse(target)} = {text}")

    # Numbers

    def place(self, node: ast.Name | ast.Subscript) -> str:
        """Return where what a number is moved by stands, in the loop over directions."""
        if isinstance(node, ast.Name):
            return f"{node.id}_rows[_r]" if node.id in self._given else f"«{node.id}»"
        if not isinstance(node.value, ast.Name):
            raise self.fail(node, "an entry of this has no known derivative.")
        return f"{node.value.id}_rows[{self.index(node)}, _r]"

    # Calls

    def call(self, node: ast.Call, name: str) -> tuple[str, Terms]:
        """Write a call of the derivative of one of the text's own functions."""
        act = self.activity
        pattern = act.pattern(node, name)
        callee = act.program.activity(name, pattern)
        back = self._derived.back(name, pattern)
        if back is not None:
            return self._gradient(node, callee, back)
        if node is not self._whole and callee.stores:
            raise self.fail(node, "a call that writes into its arguments stands alone, or alone behind `=`.")
        given, rows = [], []
        for parameter, value in zip(callee.parameters, node.args, strict=True):
            if parameter not in callee.written:
                given.append(ast.unparse(value))
            elif callee.written[parameter] == 0:
                text, terms = self.value(value)
                given.append(self.kept(text))
                one = self.name("d")
                self._waiting.append(f"«{one}» = {linear(terms)}")
                self._stored.add(one)
                rows.append(f"<{one}>")
            else:
                given.append(ast.unparse(value))
                rows.append(self._rows(value))
        self._flush()
        made = self._derived.rows(name, tuple(callee.written.items()))
        if not callee.result:
            self.lines.append(f"{made}({', '.join([*given, *rows, 'moved'])})")
            return "", []
        value, one = self.name("v"), self.name("d")
        self._stored.add(one)
        self.lines.append(f"{value} = {made}({', '.join([*given, *rows, f'<{one}>', 'moved'])})")
        return value, [("1.0", f"«{one}»")]

    def _gradient(self, node: ast.Call, callee: Activity, back: str) -> tuple[str, Terms]:
        """Write a call in reverse, and what all directions make of its gradient."""
        self._flush()
        gradients, lines = [], []
        value, one = self.name("v"), self.name("d")
        self._stored.add(one)
        lines += ["for _r in range(moved):", f"    «{one}» = 0.0"]
        for parameter, argument in zip(callee.parameters, node.args, strict=True):
            if parameter not in callee.written:
                continue
            gradient, partial = self.name("g"), self.name("p")
            self.lines.append(f"{gradient} = np.zeros({ast.unparse(argument)}.shape[0])")
            gradients.append(gradient)
            # Most entries of a long history are in no regressor.
            lines += [
                f"for _i in range({gradient}.shape[0]):",
                f"    {partial} = {gradient}[_i]",
                f"    if {partial} != 0.0:",
                "        for _r in range(moved):",
                f"            «{one}» += {partial} * {self._rows(argument)}[_i, _r]",
            ]
        arguments = [*map(ast.unparse, node.args), "1.0", *gradients]
        self.lines += [f"{value} = {back}({', '.join(arguments)})", *lines]
        return value, [("1.0", f"«{one}»")]

    # Arrays

    def _array(self, node: ast.stmt, target: ast.expr, value: ast.expr) -> None:
        act = self.activity
        if isinstance(target, ast.Name) and not isinstance(node, ast.AugAssign):
            self._flush()
            self.lines.append(ast.unparse(node))
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
        self.lines.append(ast.unparse(node))

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


def without_unused(lines: list[str]) -> list[str]:
    """Return lines without those that only set what no other line reads."""
    while True:
        used: set[str] = set()
        for line in lines:
            target, sign, value = line.partition(" = ")
            text = value if sign and re.fullmatch(r"\s*_[vpi]\d+", target) else line
            used |= set(re.findall(r"\b_[vpi]\d+\b", text))  # not `_v1_bar`: what it passes on needs no value
        left = []
        for line in lines:
            found = re.match(r"\s*(_[vpi]\d+) = (?!.*(_(tangent|back)\w*|random_\w+)\()", line)
            if not found or found[1] in used:
                left.append(line)
        if len(left) == len(lines):
            return lines
        lines = left
