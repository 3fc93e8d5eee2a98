"""Forward mode: a function that computes, for each number, its derivative along every direction (its row of tangents).

Between two calls, loops or branches, all lines that compute tangents are in one loop over the directions, after the
lines that compute values. Tangents that are used in only one such loop need no array.
"""

from __future__ import annotations

import ast
import re
from typing import Protocol

from ._tangent_activity import MEMBER_START, SLOPES, Activity, Pattern, pairs
from ._tangent_vectors import Terms, Vectors, inner, is_copy, linear, loops, names

_PLACE = re.compile(r"«(\w+)»")
_ROW = re.compile(r"<(\w+)>")


class Derived(Protocol):
    """Access to the derivatives of other functions."""

    def rows(self, name: str, pattern: Pattern) -> str:
        """Return the name of a function's forward derivative."""
        ...

    def back(self, name: str, pattern: Pattern) -> str | None:
        """Return the name of a function's reverse derivative; None if forward mode is better."""
        ...


class Rows(Vectors):
    """Generator of the forward derivative of one function."""

    def __init__(self, activity: Activity, derived: Derived) -> None:
        """Start with no lines."""
        super().__init__(activity)
        self._derived = derived
        self._waiting: list[str] = []
        self._loops: list[list[str]] = []
        self._stored: set[str] = set()
        self._whole: ast.expr | None = None
        assigned = {n.id for n in ast.walk(activity.node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        if "moved" in assigned:
            raise self.fail(activity.node, "a variable of its own is called `moved`.")
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
        result = ["result_rows"] if act.result and not act.makes_vector else []
        arguments = [*act.parameters, *(f"{p}_rows" for p in act.written), *result]
        head = [f"def {name}({', '.join([*arguments, 'moved'])}):"]
        own = [f"_own = np.empty(({len(kept)}, moved))"] if kept else []
        body = []
        for line in self.lines:
            line = _PLACE.sub(lambda m: f"_own[{kept[m[1]]}, _r]" if m[1] in kept else f"_d_{m[1]}", line)
            body.append(_ROW.sub(lambda m: f"_own[{kept[m[1]]}]", line))
        return "\n".join(head + inner(own + without_unused(body))) + "\n"

    def _rows_of_numbers(self) -> dict[str, int]:
        """Return the numbers whose tangents must be stored between loops, each with its row."""
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
        name = self.activity.program.callee_name(node.value)
        if name is not None and isinstance(node.value, ast.Call) and self.activity.pattern(node.value, name):
            self._whole = node.value
            self.call(node.value, name)
        else:
            self.lines.append(ast.unparse(node))

    def _return(self, node: ast.Return) -> None:
        if self.activity.result and self.activity.numbers and isinstance(node.value, ast.Tuple):
            self._whole, texts = node.value, []
            for place, one in enumerate(node.value.elts):
                text, terms = self.value(one)
                texts.append(self.bind(text))
                self._waiting.append(f"result_rows[{place}, _r] = {linear(terms)}")
            self._flush()
            self.lines.append(f"return {', '.join(texts)}")
        elif self.activity.result and self.activity.makes_vector and node.value is not None:
            made, value = self.name("v"), self._hoist(node.value)
            self._flush()
            self.lines += [f"{made} = {ast.unparse(value)}", f"{made}_rows = np.empty(({made}.shape[0], moved))"]
            self._fill(node, f"{made}_rows", "0", f"{made}.shape[0]", value)
            self.lines.append(f"return {made}, {made}_rows")
        elif self.activity.result and node.value is not None:
            self._whole = node.value
            text, terms = self.value(node.value)
            text = self.bind(text)
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
            called = act.program.callee_name(node.value)
            call = node.value if isinstance(node.value, ast.Call) else None
            pattern = act.pattern(call, called) if called and call else ()
            callee = act.program.activity(called, pattern) if called and pattern else None
            if callee is not None and called and call and callee.stores & set(callee.written):
                self._whole = node.value  # its result is not active, but its output arguments may be
                said = ", ".join(ast.unparse(target) for target, _ in one)
                self.lines.append(f"{said} = {self.call(call, called)[0]}")
            else:
                self.lines.append(ast.unparse(node))
            return
        if isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add | ast.Sub) and not act.is_active(node.value):
            self.lines.append(ast.unparse(node))
            return
        if act.program.search_name(node.value) and isinstance(node.value, ast.Call):
            self._search([target for target, _ in one], node.value)
            return
        if one[0][1] is None and isinstance(node.value, ast.Call):
            self._numbers(node, [target for target, _ in one], node.value)
            return
        if len(one) > 1:
            read = {name.id for _, value in one if value is not None for name in names(value)}
            if read & {ast.unparse(target) for target, _ in one}:
                raise self.fail(node, "the derivative of numbers that are exchanged is not known.")
            for target, value in one:  # no target is read later: assigning one by one is the same
                if value is not None:
                    self._assign(ast.Assign([target], value, lineno=0))
            return
        target, value = one[0]
        if value is None:
            raise self.fail(node, "the derivative of this assignment is not known.")
        self._whole = value
        if act.rank(target) == 0:
            self._number(target, *self.value(value))
        else:
            self._array(node, target, value)

    def _numbers(self, node: ast.stmt, targets: list[ast.expr], call: ast.Call) -> None:
        """Assign the numbers of a call with several results."""
        name = self.activity.program.callee_name(call)
        if name is None:
            raise self.fail(node, "the derivative of several results of a call is not known.")
        self._whole = call
        value, terms = self.call(call, name)
        for place, target in enumerate(targets):
            self._number(target, f"{value}[{place}]", [("1.0", f"{rows}[{place}, _r]") for _, rows in terms])

    def _search(self, targets: list[ast.expr], call: ast.Call) -> None:
        """Write a search and its tangents, from its slopes and the one active vector."""
        given = [ast.unparse(value) for value in call.args]
        if any(self.activity.is_active(value) for value in call.args[:-1]) or not isinstance(call.args[-1], ast.Name):
            raise self.fail(call, "only the last argument of a search may be active, and it must be a name.")
        self._flush()
        slopes, found = self.name("g"), [ast.unparse(target) for target in targets]
        self.lines += [f"{', '.join(found)} = {ast.unparse(call)}", f"{slopes} = np.zeros((2, {given[-1]}.shape[0]))"]
        self.lines.append(f"{self.activity.program.search_name(call)}{SLOPES}({', '.join([*given, *found, slopes])})")
        for place, target in enumerate(found):
            self._stored.add(target)
            self.lines += ["for _r in range(moved):", f"    «{target}» = 0.0"]
            self.lines.append(f"    for _i in range({given[-1]}.shape[0]):")
            self.lines.append(f"        «{target}» += {slopes}[{place}, _i] * {self._rows(call.args[-1])}[_i, _r]")

    def _number(self, target: ast.expr, text: str, terms: Terms) -> None:
        if self.activity.is_active(target) and isinstance(target, ast.Name | ast.Subscript):
            self._waiting.append(f"{self.place(target)} = {linear(terms)}")
        self.lines.append(f"{ast.unparse(target)} = {text}")

    # Numbers

    def place(self, node: ast.Name | ast.Subscript) -> str:
        """Return the tangent of a number, in the loop over directions."""
        if isinstance(node, ast.Name):
            return f"{node.id}_rows[_r]" if node.id in self._given else f"«{node.id}»"
        if not isinstance(node.value, ast.Name):
            raise self.fail(node, "an entry of this has no known derivative.")
        return f"{node.value.id}_rows[{self.index(node)}, _r]"

    # Calls

    def call(self, node: ast.Call, name: str) -> tuple[str, Terms]:
        """Write a call of the derivative of one of the text's own functions."""
        act = self.activity
        if name == MEMBER_START:
            return self._start(node)
        pattern = act.pattern(node, name)
        callee = act.program.activity(name, pattern)
        back = self._derived.back(name, pattern)
        if back is not None:
            return self._gradient(node, callee, back)
        if node is not self._whole and callee.stores:
            raise self.fail(
                node, "a call that writes into its arguments must be a statement, or the whole right side of one."
            )
        given, rows = [], []
        for parameter, value in zip(callee.parameters, node.args, strict=True):
            if parameter not in callee.written:
                given.append(ast.unparse(value))
            elif callee.written[parameter] == 0:
                text, terms = self.value(value)
                given.append(self.bind(text))
                one = self.name("d")
                self._waiting.append(f"«{one}» = {linear(terms)}")
                self._stored.add(one)
                rows.append(f"<{one}>")
            else:
                value = self._hoist(value)
                if is_copy(value) and isinstance(value, ast.Call) and isinstance(value.func, ast.Attribute):
                    rows.append(f"{self._rows(value.func.value)}.copy()")
                else:
                    value = self._bind_vector(value)
                    rows.append(self._rows(value))
                given.append(ast.unparse(value))
        self._flush()
        made = self._derived.rows(name, tuple(callee.written.items()))
        if not callee.result:
            said = f"{made}({', '.join([*given, *rows, 'moved'])})"
            if callee.node.returns is None or ast.unparse(callee.node.returns) == "None":
                self.lines.append(said)
                return "", []
            value = self.name("v")
            self.lines.append(f"{value} = {said}")
            return value, []
        if callee.numbers:
            value, moved = self.name("v"), self.name("m")
            self.lines.append(f"{moved} = np.empty(({len(callee.numbers)}, moved))")
            self.lines.append(f"{value} = {made}({', '.join([*given, *rows, moved, 'moved'])})")
            return value, [("1.0", moved)]
        if callee.makes_vector:
            value = self.name("v")
            self.lines.append(f"{value}, {value}_rows = {made}({', '.join([*given, *rows, 'moved'])})")
            return value, []
        value, one = self.name("v"), self.name("d")
        self._stored.add(one)
        self.lines.append(f"{value} = {made}({', '.join([*given, *rows, f'<{one}>', 'moved'])})")
        return value, [("1.0", f"«{one}»")]

    def _start(self, node: ast.Call) -> tuple[str, Terms]:
        """Write a member's start; its tangents are zero, as it only depends on parameters."""
        self._flush()
        self.lines.append(ast.unparse(node))
        rows, first, count = self._part_of_rows(node.args[3])
        self.lines += loops(count, f"{rows}[{first} + _i, _r] = 0.0")
        return "", []

    def _gradient(self, node: ast.Call, callee: Activity, back: str) -> tuple[str, Terms]:
        """Write a reverse call, and the tangents of its value from the gradient."""
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
            # Most entries of a long history are in no regressor, so their gradient is zero.
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


def without_unused(lines: list[str]) -> list[str]:
    """Return lines without assignments to variables that no other line reads."""
    while True:
        used: set[str] = set()
        for line in lines:
            target, sign, value = line.partition(" = ")
            text = value if sign and re.fullmatch(r"\s*_[vpi]\d+", target) else line
            used |= set(re.findall(r"\b_[vpi]\d+\b", text))  # not `_v1_bar`: an adjoint needs no value
        left = []
        for line in lines:
            found = re.match(r"\s*(_[vpi]\d+) = (?!.*(_(tangent|back)\w*|random_\w+)\()", line)
            if not found or found[1] in used:
                left.append(line)
        if len(left) == len(lines):
            return lines
        lines = left
