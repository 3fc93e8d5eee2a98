"""Lowering of names to indices: `p.W1` becomes `p[3]` and `x.y[i]` an entry of the state vector, before compilation.

The annotations of a function's parameters declare the names (see `_layout`). The lengths of symbols in shapes are read
from the arrays once, at the start of the function.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from typing import Any

from softneck.core import SettingsError

from ._layout import Arrays, StateVector, Symbol


def lower(
    function: ast.FunctionDef, find: Callable[[str], Any], where: str, sizes: Mapping[str, int]
) -> ast.FunctionDef:
    """Return `function` with indices in place of names, without its docstring and layout annotations.

    Args:
        function: as it is written.
        find: returns the object of a name in the function's module.
        where: the module, for messages.
        sizes: values of the `written` symbols.

    Raises SettingsError: an undeclared name, or a use of a part of a state that has no contiguous indices.
    """

    def layout(annotation: ast.expr | None) -> Any:
        found = find(annotation.id) if isinstance(annotation, ast.Name) else None
        return found if isinstance(found, type) and issubclass(found, Arrays | StateVector) else None

    layouts = {argument.arg: layout(argument.annotation) for argument in function.args.args}
    layouts = {name: found for name, found in layouts.items() if found is not None}
    for argument in function.args.args:
        argument.annotation = None if argument.arg in layouts else argument.annotation
    function.returns = None if layout(function.returns) else function.returns
    names = _Names(layouts, find, f"{where}: `{function.name}`", sizes)
    body = function.body[1:] if ast.get_docstring(function, clean=False) is not None else function.body
    body = [names.visit(statement) for statement in body] or [ast.Pass()]
    function.body = [*names.begin(), *body]
    return ast.fix_missing_locations(function)


def state_size(arrays: type[Arrays], state: type[StateVector], sizes: Mapping[str, int]) -> ast.FunctionDef:
    """Return the function `state_size` for a kind that does not define it itself."""
    text = f"def state_size(p):\n    return {state.__name__}.size(p)\n"
    function = next(node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef))
    function.args.args[0].annotation = ast.Name(arrays.__name__)
    return lower(function, {arrays.__name__: arrays, state.__name__: state}.get, "state_size", sizes)


class _Names(ast.NodeTransformer):
    """Rewriting of one function."""

    def __init__(
        self, layouts: Mapping[str, type], find: Callable[[str], Any], where: str, sizes: Mapping[str, int]
    ) -> None:
        self._layouts, self._find, self._where = layouts, find, where
        symbols = {name: symbol for layout in layouts.values() for name, symbol in layout.symbols.items()}
        self._sizes = {name: sizes[name] for name, symbol in symbols.items() if symbol.written and name in sizes}
        self._used: dict[str, ast.expr] = {}

    def begin(self) -> list[ast.stmt]:
        """Return the statements that read the used lengths."""
        return [ast.Assign([ast.Name(f"_{name}", ast.Store())], source) for name, source in self._used.items()]

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        """Return the indexed form of `p.name` or `x.name`."""
        layout = self._layout_of(node)
        if layout is None:
            return self.generic_visit(node)  # pyright: ignore[reportReturnType]
        owner: str = node.value.id  # type: ignore[attr-defined]
        if issubclass(layout, StateVector):
            return self._part(owner, layout, node.attr, None, node.ctx)
        if node.attr in layout.fields:
            return ast.Subscript(ast.Name(owner, ast.Load()), ast.Constant(layout.place(node.attr)), node.ctx)
        return self._symbol(node.attr)

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        """Return the indexed form of `x.name[...]`."""
        layout = self._layout_of(node.value)
        if layout is None or not issubclass(layout, StateVector):
            return self.generic_visit(node)  # pyright: ignore[reportReturnType]
        index = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        owner, name = node.value.value.id, node.value.attr  # type: ignore[attr-defined]
        return self._part(owner, layout, name, [self.visit(item) for item in index], node.ctx)

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """Return the length of a state for `NnState.size(p)`."""
        owner = node.func.value if isinstance(node.func, ast.Attribute) else None
        if isinstance(owner, ast.Name) and node.func.attr == "size":  # type: ignore[attr-defined]
            layout = self._find(owner.id)
            if isinstance(layout, type) and issubclass(layout, StateVector):
                return self._offset(layout, None)
        return self.generic_visit(node)  # pyright: ignore[reportReturnType]

    def _layout_of(self, node: ast.expr) -> type | None:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            return self._layouts.get(node.value.id)
        return None

    def _part(
        self, owner: str, layout: type[StateVector], name: str, index: list[ast.expr] | None, ctx: ast.expr_context
    ) -> ast.expr:
        """Return one entry of the state, a row, or a slice of entries."""
        if name not in layout.fields:
            raise self._fail(f"{layout.__name__} declares no `{name}`")
        item, begin = layout.fields[name], self._begin(owner, layout, name)
        shape = self._with_sizes(item.shape)
        place: ast.expr
        if item.open:
            place = ast.Slice(begin if index is None else _sum(begin, self._border(index[0])), None)
        elif not shape:
            place = begin
        elif index is None:
            place = ast.Slice(begin, _sum(begin, self._product(shape)))
        elif len(index) == len(shape) and not any(isinstance(i, ast.Slice) for i in index):
            place = begin
            for dimension, i in enumerate(index):
                place = _sum(place, _times(i, self._product(shape[dimension + 1 :])))
        elif len(index) == 1:
            first, last = self._rows(index[0], shape)
            row = self._product(shape[1:])
            place = ast.Slice(_sum(begin, _times(first, row)), _sum(begin, _times(last, row)))
        else:
            raise self._fail(f"`{name}[...]` with these indices is no contiguous slice of the state")
        return ast.Subscript(ast.Name(owner, ast.Load()), place, ctx)

    def _rows(self, index: ast.expr, shape: tuple[str, ...]) -> tuple[ast.expr, ast.expr]:
        if not isinstance(index, ast.Slice):
            return index, _sum(index, ast.Constant(1))
        if index.step is not None:
            raise self._fail("a slice of the state cannot have a step")
        first = ast.Constant(0) if index.lower is None else index.lower
        return first, self._length(shape[0]) if index.upper is None else index.upper

    def _border(self, index: ast.expr) -> ast.expr:
        if isinstance(index, ast.Slice) and index.upper is None and index.lower is not None:
            return index.lower
        raise self._fail("of the open part of a state only `[begin:]` can be used")

    def _begin(self, owner: str, layout: type[StateVector], name: str) -> ast.expr:
        """Return the start index of a part: a number, or a variable that is set at the start of the function."""
        begin = self._offset(layout, name)
        if isinstance(begin, ast.Constant):
            return begin
        variable = f"{owner}_{name}"
        self._used[variable] = begin
        return ast.Name(f"_{variable}", ast.Load())

    def _offset(self, layout: type[StateVector], name: str | None) -> ast.expr:
        """Return the start index of `name` in the state, or the length of all parts that are not open."""
        terms: dict[str, int] = {}
        for other, item in layout.fields.items():
            if other == name or item.open:
                break
            factor, lengths = 1, []
            for text in self._with_sizes(item.shape):
                factor, lengths = (factor * int(text), lengths) if text.isdigit() else (factor, [*lengths, text])
            term = ast.unparse(self._product(tuple(lengths))) if lengths else ""
            terms[term] = terms.get(term, 0) + factor
        total: ast.expr = ast.Constant(0)
        for term, factor in terms.items():
            total = _sum(total, _times(ast.Constant(factor), _expression(f"({term})" if term else "1")))
        return total

    def _product(self, shape: tuple[str, ...]) -> ast.expr:
        total: ast.expr = ast.Constant(1)
        for text in shape:
            total = _times(total, self._length(text))
        return total

    def _length(self, text: str) -> ast.expr:
        """Return an expression for a length, with the variables that hold its symbols."""
        names = self

        class Symbols(ast.NodeTransformer):
            def visit_Name(self, node: ast.Name) -> ast.expr:
                return names._symbol(node.id)

        return Symbols().visit(ast.parse(text, mode="eval").body)

    def _symbol(self, name: str) -> ast.expr:
        """Return the variable that holds a symbol's value, or its constant for `written` symbols."""
        if name in self._sizes:
            return ast.Constant(self._sizes[name])
        if name not in self._used:
            owner = next((key for key, layout in self._layouts.items() if issubclass(layout, Arrays)), None)
            if owner is None:
                raise self._fail(f"it needs the length `{name}` and has no arrays to read it from")
            self._used[name] = self._source(owner, self._layouts[owner], name)
        return ast.Name(f"_{name}", ast.Load())

    def _with_sizes(self, shape: tuple[str, ...]) -> tuple[str, ...]:
        """Return a shape with numbers in place of the `written` symbols."""
        for name, size in self._sizes.items():
            shape = tuple(re.sub(rf"\b{name}\b", str(size), text) for text in shape)
        return shape

    def _source(self, owner: str, layout: type[Arrays], name: str) -> ast.expr:
        if name in layout.symbols:
            symbol: Symbol = layout.symbols[name]
            array = f"{owner}[{layout.place(symbol.array)}]"
            if symbol.function is not None:
                return _expression(f"{symbol.function.__name__}({array})")
            return _expression(f"int({array}[{', '.join(map(str, symbol.places))}])")
        for place, item in enumerate(layout.fields.values()):
            if name in item.shape:
                return _expression(f"{owner}[{place}].shape[{item.shape.index(name)}]")
        raise self._fail(f"{layout.__name__} declares neither an array nor a length `{name}`")

    def _fail(self, problem: str) -> SettingsError:
        return SettingsError(f"{self._where}: {problem}.")


def _expression(text: str) -> ast.expr:
    return ast.parse(text, mode="eval").body


def _sum(left: ast.expr, right: ast.expr) -> ast.expr:
    if isinstance(left, ast.Constant) and isinstance(right, ast.Constant):
        return ast.Constant(left.value + right.value)  # type: ignore[operator]
    if isinstance(left, ast.Constant) and left.value == 0:
        return right
    if isinstance(right, ast.Constant) and right.value == 0:
        return left
    return ast.BinOp(left, ast.Add(), right)


def _times(left: ast.expr, right: ast.expr) -> ast.expr:
    for one, other in ((left, right), (right, left)):
        if isinstance(one, ast.Constant) and one.value == 1:
            return other
        if isinstance(one, ast.Constant) and one.value == 0:
            return ast.Constant(0)
    return ast.BinOp(left, ast.Mult(), right)
