"""Unrolling for a number of motors and outputs: `MOTORS` and `OUTPUTS` become constants, and their loops are unrolled.

    pull = tuple(tension(x[j]) for j in range(MOTORS))     pull = (tension(x[0]), tension(x[1]), tension(x[2]))
    return (bend, *(speed[j] for j in range(MOTORS)))      return (bend, speed[0], speed[1], speed[2])
    for j in range(MOTORS):                                total += pull[0]
        total += pull[j]                                   total += pull[1] ...

Numbers in tuples stay in registers, where arrays would not; neither numba nor C makes tuples in loops.
"""

from __future__ import annotations

import ast
import copy
import operator
from collections.abc import Mapping
from typing import Any

_NAMES = {"MOTORS": "motors", "OUTPUTS": "outputs"}
_FOLDED = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul}


def unroll(node: ast.stmt, sizes: Mapping[str, int]) -> ast.stmt:
    """Return a statement unrolled for a robot of these sizes; a statement without size names stays as it is."""
    known = {name: sizes[size] for name, size in _NAMES.items() if size in sizes}
    if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id in known for t in node.targets):
        return node  # where the names are defined
    return _Unroll(known).visit(node) if _uses(node, known) else node


class _Unroll(ast.NodeTransformer):
    def __init__(self, known: Mapping[str, int]) -> None:
        self._known = known

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Return the value of a size name."""
        return ast.Constant(self._known[node.id]) if node.id in self._known else node

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        """Evaluate an operation on whole numbers of which one was a size name."""
        if not _uses(node, self._known):
            return node
        self.generic_visit(node)
        left, right, fold = _whole(node.left), _whole(node.right), _FOLDED.get(type(node.op))
        return node if left is None or right is None or fold is None else ast.Constant(fold(left, right))

    def visit_IfExp(self, node: ast.IfExp) -> ast.expr:
        """Return the chosen side if the test depends on a size name alone."""
        holds = self._evaluate_test(node.test)
        return self.generic_visit(node) if holds is None else self.visit(node.body if holds else node.orelse)  # pyright: ignore[reportReturnType]

    def visit_If(self, node: ast.If) -> Any:
        """Return the statements of the chosen branch if the test depends on a size name alone."""
        holds = self._evaluate_test(node.test)
        if holds is None:
            return self.generic_visit(node)
        return [part for item in (node.body if holds else node.orelse) for part in _as_list(self.visit(item))]

    def visit_For(self, node: ast.For) -> Any:
        """Return the unrolled statements of a loop over a size name."""
        count = self._count(node.iter)
        if count is None or not isinstance(node.target, ast.Name):
            return self.generic_visit(node)
        return [
            part for i in range(count) for item in node.body for part in _as_list(self._at(node.target.id, i, item))
        ]

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """Return `tuple(... for j in range(MOTORS))` as a tuple."""
        written = (
            isinstance(node.func, ast.Name) and node.func.id == "tuple" and isinstance(node.args[0], ast.GeneratorExp)
        )
        return ast.Tuple(self._items(node.args[0]), ast.Load()) if written else self.generic_visit(node)  # pyright: ignore

    def visit_Tuple(self, node: ast.Tuple) -> ast.expr:
        """Return a tuple with the entries of `*(... for j in range(MOTORS))`."""
        items: list[ast.expr] = []
        for item in node.elts:
            items += self._items(item.value) if isinstance(item, ast.Starred) else [self.visit(item)]
        return ast.Tuple(items, node.ctx)

    def _items(self, node: Any) -> list[ast.expr]:
        (loop,) = node.generators
        return [self._at(loop.target.id, i, node.elt) for i in range(self._count(loop.iter) or 0)]

    def _at(self, name: str, number: int, node: Any) -> Any:
        return _Unroll({**self._known, name: number}).visit(copy.deepcopy(node))

    def _count(self, node: Any) -> int | None:
        """Return the number of iterations of `range(2 * MOTORS)` and the like; None without a size name."""
        if not isinstance(node, ast.Call) or len(node.args) != 1 or not _uses(node, self._known):
            return None
        return _whole(self.visit(copy.deepcopy(node.args[0])))

    def _evaluate_test(self, test: ast.expr) -> bool | None:
        """Return whether `OUTPUTS > 1` and the like hold; None for other tests."""
        if not isinstance(test, ast.Compare) or not isinstance(test.ops[0], ast.Gt) or not _uses(test, self._known):
            return None
        left, right = (_whole(self.visit(copy.deepcopy(side))) for side in (test.left, test.comparators[0]))
        return None if left is None or right is None else left > right


def _uses(node: ast.AST, known: Mapping[str, int]) -> bool:
    return any(isinstance(part, ast.Name) and part.id in known for part in ast.walk(node))


def _whole(node: ast.expr) -> int | None:
    return node.value if isinstance(node, ast.Constant) and type(node.value) is int else None


def _as_list(found: Any) -> list[ast.stmt]:
    return found if isinstance(found, list) else [found]
