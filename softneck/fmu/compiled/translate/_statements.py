"""Translation of statements to C."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Callable
from typing import Any

from ._expressions import Expressions
from ._scope import FLOAT, INT, MATRIX, NONE, VECTOR, Bundle, Scalar, Scope, Type, Value, View, one_type


class Statements:
    """Translator of the statements of one function into its scope.

    Attributes:
        result: type of the result; None before the first `return`.
    """

    def __init__(self, function: ast.FunctionDef, scope: Scope, expressions: Expressions) -> None:
        self.scope, self.ex = scope, expressions
        self.result: Type | None = None
        self._function = function
        names = (part for part in ast.walk(function) if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store))
        self._bound = Counter([name.id for name in names] + [argument.arg for argument in function.args.args])

    def block(self, statements: list[ast.stmt]) -> None:
        """Write statements in order."""
        for node in statements:
            handler: Callable[[Any], None] | None = getattr(self, f"_{type(node).__name__.lower()}", None)
            if handler is None:
                raise self.scope.fail(node, "there is no translation to C for this statement.")
            handler(node)

    # Simple ones

    def _expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):  # a docstring
            self.ex.value(node.value)  # a call writes a statement

    def _break(self, node: ast.Break) -> None:
        del node
        self.scope.emit("break;")

    def _continue(self, node: ast.Continue) -> None:
        del node
        self.scope.emit("continue;")

    def _return(self, node: ast.Return) -> None:
        constant = isinstance(node.value, ast.Constant) and node.value.value is None
        if node.value is None or constant:
            self._set_result(NONE)
            self.scope.emit("goto leave;")
            return
        value = self.ex.value(node.value)
        self._set_result(value.type)
        self.scope.emit(f"result = {value.code};")
        self.scope.emit("goto leave;")

    def _set_result(self, kind: Type) -> None:
        self.result = one_type(self.result or kind, kind, f"{self.scope.function}: `return`")

    # Assignment

    def _assign(self, node: ast.Assign) -> None:
        if len(node.targets) == 1 and isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple):
            # All right sides are evaluated before any assignment; no tuple is made.
            values = [self.scope.store(value) for value in self.ex.evaluate_all(node.value.elts)]
            for target, value in zip(node.targets[0].elts, values, strict=True):
                self.assign(target, value)
            return
        value = self.ex.value(_not_copied(node))
        if len(node.targets) > 1:
            value = self.scope.store(value)
        for target in node.targets:
            self.assign(target, value)

    def assign(self, target: ast.expr, value: Value) -> None:
        """Write `target = value`."""
        if value.type == NONE:
            raise self.scope.fail(target, "there is no value to assign.")
        if isinstance(target, ast.Name):
            if isinstance(value.type, Bundle) and self._bound[target.id] == 1 and self._is_by_pointer(value):
                self.scope.variables.setdefault(target.id, value.type)
                self.scope.by_pointer[target.id] = value.code
            elif target.id != "_":
                self.scope.bind(target.id, value.type)
                self.scope.emit(f"v_{target.id} = {value.code};")
        elif isinstance(target, ast.Tuple):
            if not isinstance(value.type, Bundle) or len(value.type.items) != len(target.elts):
                raise self.scope.fail(target, "the tuple has another length.")
            # The target of a pointer parameter does not change meanwhile: it is read in place.
            held = value if self._is_by_pointer(value) else self.scope.store(value)
            for i, (part, kind) in enumerate(zip(target.elts, value.type.items, strict=True)):
                self.assign(part, Value(held.code + self.scope.types.field(value.type, i), kind))
        elif isinstance(target, ast.Subscript):
            self._store(target, value)
        else:
            raise self.scope.fail(target, "nothing can be assigned to this.")

    def _is_by_pointer(self, value: Value) -> bool:
        """Return whether `value` is in the target of a pointer parameter."""
        return self.scope.has_place(value) and any(
            value.code.startswith(place) for place in self.scope.by_pointer.values()
        )

    def _store(self, target: ast.Subscript, value: Value) -> None:
        # Python evaluates the value before the target.
        before = len(self.scope.lines)
        place = self.ex.value(target)
        if len(self.scope.lines) > before and value.known is None:
            written = self.scope.cut_lines(before)
            value = self.scope.store(value)
            self.scope.lines += written
        self.put(target, place, value)

    def put(self, node: ast.AST, place: Value, value: Value) -> None:
        """Write `value` to an entry or into a part of an array."""
        if isinstance(place.type, Scalar):
            if place.type == INT and value.type == FLOAT:
                raise self.scope.fail(node, "a float does not go into whole numbers.")
            self.scope.emit(f"{place.code} = {self.scope.cast(value, place.type)};")
        elif place.type == VECTOR and isinstance(value.type, Scalar):
            self.scope.emit(f"sn_fill1({place.code}, {self.scope.cast(value, FLOAT)});")
        elif place.type == value.type == VECTOR:
            self.scope.emit(f"sn_set1(w, {place.code}, {value.code});")
        else:
            raise self.scope.fail(node, f"{value.type} does not go into {place.type}.")

    def _augassign(self, node: ast.AugAssign) -> None:
        place = self.ex.value(node.target)
        if isinstance(place.type, View):
            self._in_place(node, place)
        elif isinstance(node.target, ast.Subscript):
            # Python reads the entry before it evaluates the right side.
            old = self.scope.store(place)
            self.put(node, place, self.ex.binary(node, old, self.ex.value(node.value)))
        else:
            self.assign(node.target, self.ex.binary(node, place, self.ex.value(node.value)))

    def _in_place(self, node: ast.AugAssign, place: Value) -> None:
        names: dict[type, str] = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.Div: "div"}
        name = names.get(type(node.op))
        if name is None or place.type not in (VECTOR, MATRIX):
            raise self.scope.fail(node, "this is not supported in place.")
        value = self.ex.value(node.value)
        number = isinstance(value.type, Scalar)
        if not number and value.type != place.type:
            raise self.scope.fail(node, f"{value.type} does not go into {place.type}.")
        letters = {(VECTOR, False): "iv", (VECTOR, True): "is", (MATRIX, False): "im", (MATRIX, True): "ims"}
        code = self.scope.cast(value, FLOAT) if number else self.scope.argument(value)
        self.scope.emit(f"sn_{name}_{letters[(place.type, number)]}(w, {self.scope.argument(place)}, {code});")

    # Control

    def _if(self, node: ast.If) -> None:
        test = self.ex.value(node.test)
        if test.known is not None:  # the other branch need not have a translation
            self.block(node.body if test.known else node.orelse)
            return
        self.scope.emit(f"if ({self.ex.truth(test, node)}) {{")
        self.block(node.body)
        if node.orelse:
            self.scope.emit("} else {")
            self.block(node.orelse)
        self.scope.emit("}")

    def _while(self, node: ast.While) -> None:
        if node.orelse:
            raise self.scope.fail(node, "`else` of a loop is not supported.")

        def head() -> None:
            test = self.ex.value(node.test)
            if not test.known:  # not `while True`
                self.scope.emit(f"if (!{self.ex.truth(test, node)}) break;")
            self.scope.emit("sn_rounds(w, 1);")

        self._loop(node, "for (;;) {", head)

    def _for(self, node: ast.For) -> None:
        call, target = node.iter, node.target
        plain = isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "range"
        if not plain or node.orelse or not isinstance(target, ast.Name) or not isinstance(call, ast.Call):
            raise self.scope.fail(node, "`for NAME in range(...)` is the only loop supported.")
        borders = self.ex.evaluate_all(call.args)
        step = borders[2].known if len(borders) == 3 else 1
        if any(border.type != INT for border in borders) or not isinstance(step, int) or step == 0:
            raise self.scope.fail(node, "`range` takes whole numbers, its step a constant.")
        first = borders[0] if len(borders) > 1 else Value("0", INT, 0)
        last = borders[1] if len(borders) > 1 else borders[0]
        counter, end = self.scope.temporary(INT), self.scope.temporary(INT)
        self.scope.emit(f"{counter} = {first.code}; {end} = {last.code};")
        ahead, sign = (f"{end} - {counter}", "<") if step > 0 else (f"{counter} - {end}", ">")
        if first.known is None or last.known is None:
            self.scope.emit(f"sn_rounds(w, {ahead});")

        def head() -> None:
            if target.id != "_":
                self.scope.bind(target.id, INT)
                self.scope.emit(f"v_{target.id} = {counter};")

        self._loop(node, f"for (; {counter} {sign} {end}; {counter} += {step}) {{", head)

    def _loop(self, node: ast.For | ast.While, opening: str, head: Callable[[], None]) -> None:
        """Write a loop; each iteration releases its workspace, unless a variable carries it on."""
        before, self.scope.allocates = self.scope.allocates, False
        with self.scope.capture() as lines:
            head()
            self.block(node.body)
        if self.scope.allocates and not self._carries(node):
            mark = self.scope.temporary(INT)
            self.scope.emit(f"{mark} = (int64_t)w->top;")
            lines = [f"w->top = (size_t){mark};", *lines]
        self.scope.allocates |= before
        self.scope.lines += [opening, *lines, "}"]

    def _carries(self, node: ast.For | ast.While) -> bool:
        """Return whether an array assigned in the loop may be read in a later iteration or after the loop."""
        bound = {
            name.id for part in ast.walk(node) if isinstance(part, ast.Assign)
            for target in part.targets for name in ast.walk(target)
            if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
        }  # fmt: skip
        arrays = {name for name in bound if contains_array(self.scope.variables.get(name))}
        inside = {id(part) for part in ast.walk(node)}
        names = (part for part in ast.walk(self._function) if isinstance(part, ast.Name) and id(part) not in inside)
        return bool(arrays & {name.id for name in names})


def contains_array(kind: Type | None) -> bool:
    if isinstance(kind, Bundle):
        return any(contains_array(item) for item in kind.items)
    return isinstance(kind, View)


def _not_copied(node: ast.Assign) -> ast.expr:
    """Return the assigned expression; `b` for `a[i:j] = b.copy()`, as writing into a slice allows overlap."""
    call, into_part = node.value, len(node.targets) == 1 and isinstance(node.targets[0], ast.Subscript)
    method = call.func if isinstance(call, ast.Call) and not call.args else None
    return method.value if into_part and isinstance(method, ast.Attribute) and method.attr == "copy" else call
