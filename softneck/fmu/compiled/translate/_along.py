"""The derivative of a step along one direction: what FMI asks for at a time, without loops over directions."""

from __future__ import annotations

import ast
from functools import cache

from softneck.runtime._tangent import with_tangent


@cache
def along_one(text: str) -> str:
    """Return the bundle `text` with its `step_tangent` (see `softneck.runtime._tangent`) for one direction alone.

    Raises:
        TangentError: the step has no derivative.
    """
    return ast.unparse(ast.fix_missing_locations(_One().visit(ast.parse(with_tangent(text)))))


class _One(ast.NodeTransformer):
    def __init__(self) -> None:
        self._direction = ""

    def visit_For(self, node: ast.For) -> ast.AST | list[ast.stmt]:
        """Return what stands in a loop over directions, and any other loop as it is."""
        if ast.unparse(node.iter) != "range(moved)":
            return self.generic_visit(node)
        self._direction = ast.unparse(node.target)
        body = [self.visit(statement) for statement in node.body]
        self._direction = ""
        return body

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Return the first direction for the one of a loop."""
        return ast.Constant(0) if node.id == self._direction else node
