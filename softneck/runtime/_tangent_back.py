"""Reverse mode: the gradient of a function that reduces loops or whole arrays to one number.

`f_back(..., seed, x_bar)` returns f and adds seed * df/dx to the adjoint `x_bar`. Values are computed forward; then the
statements follow in reverse order, each propagating the adjoint of its variable. A loop is run once more from its
start, so it may accumulate sums only; a short loop of fixed length is unrolled.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Callable

from ._tangent_activity import Activity, Pattern, is_numpy, statements
from ._tangent_rows import Derived, without_unused
from ._tangent_vectors import Lowering, Terms, inner, names, zero_undefined

_MOST_UNROLLED = 4
# Derivatives of elementwise functions, with v for the value and x for the argument.
_EACH = {"tanh": "(1.0 - {v} * {v})", "exp": "{v}", "sin": "np.cos({x})", "cos": "-np.sin({x})", "sqrt": "0.5 / {v}"}


def is_reverse_better(activity: Activity, pattern: Pattern) -> bool:
    """Return whether reverse mode suits a function: one number out of vectors, by loops or products."""
    node = activity.node
    returns = ast.unparse(node.returns) if node.returns else ""
    stores = any(isinstance(part, ast.Subscript) and isinstance(part.ctx, ast.Store) for part in ast.walk(node))
    plain = returns == "float" and activity.result and not stores
    vectors = all(rank == 1 for _, rank in pattern) and dict(pattern) == activity.written
    many = any(isinstance(part, ast.For) or is_numpy(part, "dot") for part in ast.walk(node))
    return plain and vectors and many


class Back(Lowering):
    """Generator of the reverse derivative of one function."""

    def __init__(self, activity: Activity, derived: Derived) -> None:
        """Start with no lines."""
        super().__init__(activity)
        self._derived = derived
        # Lines that follow in reverse after the adjoints of the current statement.
        self._after: list[str] = []
        self._sums: set[str] = set()

    def text(self, name: str) -> str:
        """Return the derived function, called `name`; raise TangentError where it cannot be reversed."""
        act = self.activity
        body = _unroll(act.node.body)
        if not isinstance(body[-1], ast.Return) or any(isinstance(s, ast.Return) for s in statements(body[:-1])):
            raise self.fail(act.node, "it has a `return` before its last statement.")
        forward, back = self._block(body)
        arguments = [*act.parameters, "seed", *(f"{parameter}_bar" for parameter in act.written)]
        stored = {n.id for n in ast.walk(act.node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        bars = [f"{n}_bar = 0.0" for n in sorted(stored) if act.root(n) in act.active and act.ranks.get(n) == 0]
        lines = without_unused([*forward, *bars, *back, "return _result"])
        return "\n".join([f"def {name}({', '.join(arguments)}):", *inner(lines)]) + "\n"

    def _block(self, body: list[ast.stmt]) -> tuple[list[str], list[str]]:
        """Return the forward lines and the reverse lines."""
        forward: list[str] = []
        back: list[str] = []
        for node in body:
            outside, self.lines = self.lines, []
            handler: Callable[[ast.stmt], list[str]] | None = {
                ast.Assign: self._assign, ast.AugAssign: self._assign, ast.If: self._if, ast.For: self._for,
                ast.Return: self._return,
            }.get(type(node))  # type: ignore[assignment]  # fmt: skip
            if handler is None:
                raise self.fail(node, "this statement is not reversed.")
            reverse = handler(node)
            forward, back = forward + self.lines, reverse + back
            self.lines = outside
        return forward, back

    def _assign(self, node: ast.stmt) -> list[str]:
        act = self.activity
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target  # type: ignore[attr-defined]
        value: ast.expr = node.value  # type: ignore[attr-defined]
        if isinstance(node, ast.AugAssign):
            value = ast.BinOp(ast.parse(ast.unparse(target), mode="eval").body, node.op, value)
        if not isinstance(target, ast.Name) or (isinstance(node, ast.Assign) and len(node.targets) > 1):
            raise self.fail(node, "this assignment is not reversed.")
        if not act.is_active(target):
            self.lines.append(ast.unparse(node))
            return []
        if act.rank(target) != 0:
            return self._vector(node, target, value)
        self._after = []
        text, terms = self.value(value)
        if target.id not in self._sums:
            self.lines.append(f"{target.id} = {text}")
        own = [partial for partial, place in terms if place == f"{target.id}_bar"]
        passed = self._propagate([term for term in terms if term[1] != f"{target.id}_bar"], f"{target.id}_bar")
        kept = [f"{target.id}_bar = {own[0]} * {target.id}_bar"] if own and own[0] != "1.0" else []
        return [*passed, *(kept if own else [f"{target.id}_bar = 0.0"]), *self._after]

    def _return(self, node: ast.stmt) -> list[str]:
        assert_value = node.value if isinstance(node, ast.Return) else None
        if assert_value is None:
            raise self.fail(node, "it returns nothing.")
        self._after = []
        text, terms = self.value(assert_value)
        self.lines.append(f"_result = {text}")
        return [*self._propagate(terms, "seed"), *self._after]

    def _propagate(self, terms: Terms, bar: str) -> list[str]:
        """Return the lines that propagate the adjoint `bar` to the places of `terms`."""
        lines = []
        for partial, place in terms:
            passed = {"1.0": bar, "-1.0": f"-{bar}"}.get(partial, f"{partial} * {bar}")
            lines.append(f"{place} {'=' if place.startswith('_') else '+='} {passed}")
        return lines

    def _if(self, node: ast.stmt) -> list[str]:
        if not isinstance(node, ast.If):
            return []
        test = self.bind(f"1.0 if {ast.unparse(node.test)} else 0.0", "c")
        branches = [self._block(part) for part in (node.body, node.orelse)]
        self.lines += zero_undefined([forward for forward, _ in branches])
        back = []
        for number, (forward, reverse) in enumerate(branches):
            head = f"if {test} {'>' if number == 0 else '<'} 0.5:"
            self.lines += [head, *inner(forward)] if forward else []
            back += [head, *inner(reverse)] if reverse else []
        return back

    def _for(self, node: ast.stmt) -> list[str]:
        if not isinstance(node, ast.For):
            return []
        head = ast.unparse(node).splitlines()[0]
        self.lines += ast.unparse(node).splitlines()
        before, self._sums = self._sums, self._sums | self._sums_of(node)
        outside, self.lines = self.lines, []
        forward, back = self._block(node.body)
        self.lines, self._sums = outside, before
        return [head, *inner([*forward, *back] or ["pass"])]

    def _sums_of(self, node: ast.For) -> set[str]:
        """Return the sums of a loop that it does not read; raise TangentError if it carries other values."""
        used = [part for statement in node.body for part in ast.walk(statement) if isinstance(part, ast.Name)]
        reads = {name.id for name in used if isinstance(name.ctx, ast.Load)}
        written = {name.id for name in used if isinstance(name.ctx, ast.Store)}
        added: set[str] = set()
        loops: set[str] = set()
        for part in statements(node.body):
            if isinstance(part, ast.AugAssign | ast.For) and isinstance(part.target, ast.Name):
                adds = isinstance(part, ast.AugAssign) and isinstance(part.op, ast.Add | ast.Sub)
                (added if adds else loops).update([part.target.id] if adds or isinstance(part, ast.For) else [])
        fresh: set[str] = set()
        for statement in node.body:
            if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
                if statement.targets[0].id not in {n.id for n in names(statement.value)} | added:
                    fresh.add(statement.targets[0].id)
                added -= fresh
        sums = {name for name in added if name not in reads}
        if written - sums - fresh - loops:
            raise self.fail(node, "a value that this loop carries to its next iteration is not reversed.")
        return sums

    # Places

    def place(self, node: ast.Name | ast.Subscript) -> str:
        """Return the adjoint of a number."""
        if isinstance(node, ast.Name):
            return f"{node.id}_bar"
        if not isinstance(node.value, ast.Name) or node.value.id not in self.activity.parameters:
            raise self.fail(node, "an entry of this is not reversed.")
        return f"{node.value.id}_bar[{self.index(node)}]"

    def call(self, node: ast.Call, name: str) -> tuple[str, Terms]:
        """Write a call forward; its reverse call follows the reverse lines of the statement."""
        act = self.activity
        pattern = act.pattern(node, name)
        back = self._derived.back(name, pattern)
        if back is None:
            raise self.fail(node, "this call is not reversed.")
        callee = act.program.activity(name, pattern)
        arguments = list(map(ast.unparse, node.args))
        value = self.bind(f"{name}({', '.join(arguments)})")
        bars = [f"{a}_bar" for p, a in zip(callee.parameters, arguments, strict=True) if p in callee.written]
        if not all(bar.removesuffix("_bar") in act.parameters for bar in bars):
            raise self.fail(node, "this call is not reversed.")
        self._after.append(f"{back}({', '.join([*arguments, f'{value}_bar', *bars])})")
        return value, [("1.0", f"{value}_bar")]

    # Vectors

    def product(self, node: ast.Call) -> tuple[str, Terms]:
        """Write a product of vectors."""
        active = [act for act in node.args if self.activity.is_active(act)]
        if len(active) != 1 or self.activity.rank(node) != 0:
            raise self.fail(node, "this product is not reversed.")
        other = next(value for value in node.args if value is not active[0])
        held, push = self._split_vector(active[0])
        texts = [held if value is active[0] else ast.unparse(value) for value in node.args]
        value = self.bind(f"np.dot({', '.join(texts)})")
        self._after += push(f"({ast.unparse(other)} * {value}_bar)")
        return value, [("1.0", f"{value}_bar")]

    def _vector(self, node: ast.stmt, target: ast.Name, value: ast.expr) -> list[str]:
        stores = [n for n in ast.walk(self.activity.node) if isinstance(n, ast.Name) and n.id == target.id]
        if isinstance(node, ast.AugAssign) or [isinstance(n.ctx, ast.Store) for n in stores].count(True) != 1:
            raise self.fail(node, "a vector that is overwritten is not reversed.")
        if sum(isinstance(n.ctx, ast.Load) for n in stores) > 1:
            raise self.fail(node, "a vector that is read twice is not reversed.")
        held, push = self._split_vector(value)
        self.lines.append(f"{target.id} = {held}")
        return push(f"{target.id}_bar")

    def _split_vector(self, node: ast.expr) -> tuple[str, Callable[[str], list[str]]]:
        """Return a vector's text, and the function that propagates its adjoint."""
        act = self.activity
        if not act.is_active(node):
            return f"({ast.unparse(node)})", lambda _: []
        if isinstance(node, ast.Name):
            sign = "+=" if node.id in act.parameters else "="
            return node.id, lambda bar: [f"{node.id}_bar {sign} {bar}"]
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub | ast.Mult | ast.Div):
            return self._split_pair(node)
        if is_numpy(node, *_EACH) and isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            text, push = self._split_vector(node.args[0])
            argument = self.bind(text, "x")
            value = self.bind(f"np.{node.func.attr}({argument})", "x")
            slope = _EACH[node.func.attr].format(v=value, x=argument)
            return value, lambda bar: push(f"({bar} * {slope})")
        if is_numpy(node, "dot") and isinstance(node, ast.Call) and not act.is_active(node.args[0]):
            matrix = ast.unparse(node.args[0])
            text, push = self._split_vector(node.args[1])
            return f"np.dot({matrix}, {text})", lambda bar: push(f"np.dot({bar}, {matrix})")
        raise self.fail(node, "this array is not reversed.")

    def _split_pair(self, node: ast.BinOp) -> tuple[str, Callable[[str], list[str]]]:
        (a, first), (b, second) = self._split_vector(node.left), self._split_vector(node.right)
        if isinstance(node.op, ast.Add | ast.Sub):
            sign = "+" if isinstance(node.op, ast.Add) else "-"
            return f"({a} {sign} {b})", lambda bar: first(bar) + second(bar if sign == "+" else f"(-{bar})")
        if not isinstance(node.op, ast.Div) or self.activity.is_active(node.right):
            raise self.fail(node, "this array is not reversed.")
        return f"({a} / {b})", lambda bar: first(f"({bar} / {b})")


def _unroll(body: list[ast.stmt]) -> list[ast.stmt]:
    """Return statements with short loops of fixed length unrolled."""
    out: list[ast.stmt] = []
    for node in body:
        size = None
        if isinstance(node, ast.For) and isinstance(node.iter, ast.Call) and len(node.iter.args) == 1:
            size = node.iter.args[0].value if isinstance(node.iter.args[0], ast.Constant) else None
        if isinstance(size, int) and size <= _MOST_UNROLLED and isinstance(node, ast.For):
            counter = ast.unparse(node.target)
            for i in range(size):
                text = [ast.unparse(_Replace(counter, i).visit(copy.deepcopy(s))) for s in _unroll(node.body)]
                out += ast.parse("\n".join(text)).body
            continue
        new = copy.copy(node)
        for part in ("body", "orelse"):
            if getattr(new, part, None):
                setattr(new, part, _unroll(getattr(new, part)))
        out.append(new)
    return out


class _Replace(ast.NodeTransformer):
    def __init__(self, name: str, value: int) -> None:
        self._name, self._value = name, value

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Replace the counter by its number."""
        return ast.Constant(self._value) if node.id == self._name else node
