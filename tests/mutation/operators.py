"""Mutants that cosmic-ray lacks: the other extreme, a branch never taken, an error not raised or not handled."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import parso  # pyright: ignore[reportMissingImports]
from cosmic_ray.operators import operator  # pyright: ignore[reportMissingImports]

# Its methods are declared to return nothing.
Operator: Any = operator.Operator

# What stands for what else. A mean becomes the best: of most numbers here the smallest.
OTHERS = {
    "max": "min", "min": "max", "maximum": "minimum", "minimum": "maximum", "argmax": "argmin", "argmin": "argmax",
    "nanmax": "nanmin", "nanmin": "nanmax", "mean": "min", "median": "max", "any": "all", "all": "any",
    "floor": "ceil", "ceil": "floor", "isfinite": "isreal",
}  # fmt: skip


class OtherExtreme(Operator):
    """Replace a function or method by its opposite, such as `max` by `min`."""

    def mutation_positions(self, node: Any) -> Iterator[Any]:
        """Yield a name of the table that is called or passed on, no argument's or attribute's name."""
        if node.type != "name" or node.value not in OTHERS:
            return
        called = (after := node.get_next_leaf()) is not None and after.value == "("
        before = node.get_previous_leaf()
        keyword = after is not None and after.value == "=" and node.parent.type == "argument"
        if called or not (keyword or (before is not None and before.value in (".", "def", "import", ","))):
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """Return the other name."""
        del index
        node.value = OTHERS[node.value]
        return node

    @classmethod
    def examples(cls) -> tuple[Any, ...]:
        """Return none: `mutants_of` is tried on whole files."""
        return ()


class NeverTaken(OtherExtreme):
    """Never take the branch of an `if` or `elif`."""

    def mutation_positions(self, node: Any) -> Iterator[Any]:
        """Yield its conditions."""
        if node.type == "if_stmt":
            yield from ((node.children[i + 1].start_pos, node.children[i + 1].end_pos) for i in self._places(node))

    @staticmethod
    def _places(node: Any) -> list[int]:
        return [i for i, child in enumerate(node.children) if getattr(child, "value", "") in ("if", "elif")]

    def mutate(self, node: Any, index: int) -> Any:
        """Return the statement with a condition that is false."""
        node.children[self._places(node)[index] + 1] = parso.parse(" False")
        return node


class NotRaised(OtherExtreme):
    """Do not raise an error."""

    def mutation_positions(self, node: Any) -> Iterator[Any]:
        """Yield `raise` statements."""
        if node.type == "raise_stmt" or (node.type == "keyword" and node.value == "raise" and _alone(node)):
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """Return `pass`."""
        del index
        first = node.get_first_leaf()
        return parso.parse(f"{first.prefix}pass")


class Swallowed(OtherExtreme):
    """Do nothing where an error is caught: the body of an `except` is `pass`."""

    def mutation_positions(self, node: Any) -> Iterator[Any]:
        """Yield the bodies."""
        if node.type == "try_stmt":
            yield from ((node.children[i].start_pos, node.children[i].end_pos) for i in self._bodies(node))

    @staticmethod
    def _bodies(node: Any) -> list[int]:
        heads = [i for i, child in enumerate(node.children) if child.type == "except_clause"]
        return [i + 2 for i in heads if node.children[i + 2].type == "suite"]

    def mutate(self, node: Any, index: int) -> Any:
        """Return the statement with one handler that does nothing."""
        at = self._bodies(node)[index]
        suite = node.children[at]
        indent = suite.children[1].get_first_leaf().prefix if len(suite.children) > 1 else "    "
        node.children[at] = parso.parse(f"\n{indent.splitlines()[-1] if indent else '    '}pass\n")
        return node


def _alone(node: Any) -> bool:
    return node.parent.type != "raise_stmt"


OWN = {item.__name__: item for item in (OtherExtreme, NeverTaken, NotRaised, Swallowed)}
