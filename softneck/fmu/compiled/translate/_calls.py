"""Translation of calls of numpy, math and Python's built-in functions to C."""

from __future__ import annotations

import ast
from typing import Protocol

from ._scope import BOOL, FLOAT, INT, MATRIX, VECTOR, Scalar, Scope, Type, Value, View

# Function of one number in numpy or math -> its name in C.
_EACH = {
    "sqrt": "sqrt", "sin": "sn_sin", "cos": "sn_cos", "tan": "sn_tan", "tanh": "sn_tanh", "exp": "sn_exp",
    "log": "sn_log", "atan": "sn_atan",
}  # fmt: skip
_PAIR = {"atan2": "sn_atan2", "copysign": "copysign"}
_ENTRYWISE = {"sqrt": "sn_sqrt_v", "tanh": "sn_tanh_v", "abs": "sn_absolute_v", "sort": "sn_sorted"}
_REDUCTIONS = {"max": "sn_largest(w, {})", "min": "sn_least(w, {})"}


class CallContext(Protocol):
    """The part of `_expressions.Expressions` that the translation of calls uses."""

    scope: Scope

    def evaluate_all(self, nodes: list[ast.expr]) -> list[Value]: ...
    def scalar(self, node: ast.expr, kind: Scalar) -> str: ...
    def truth(self, value: Value, node: ast.AST) -> str: ...
    def allocate(self, code: str, kind: Type) -> Value: ...


def numpy_call(ex: CallContext, node: ast.AST, name: str, values: list[Value]) -> Value:
    """Return the C of `np.NAME(...)` or `math.NAME(...)`."""
    if name in ("empty", "zeros"):
        return _new_array(ex, node, values, whole=_whole(ex, node))
    if isinstance(node, ast.Call) and node.keywords:
        raise ex.scope.fail(node, "keyword arguments are not supported here.")
    kinds = [value.type for value in values]
    numbers = all(isinstance(kind, Scalar) for kind in kinds)
    if numbers and len(values) in (1, 2):
        found = _of_numbers(name, [ex.scope.cast(value, FLOAT) for value in values])
        if found is not None:
            return found
    if name == "dot" and len(values) == 2:
        return _dot(ex, node, values)
    if name in _REDUCTIONS and kinds == [MATRIX]:
        return Value(_REDUCTIONS[name].format(f"sn_flat(w, {ex.scope.argument(values[0])})"), FLOAT)
    if kinds == [VECTOR] and name in _REDUCTIONS:
        return Value(_REDUCTIONS[name].format(values[0].code), FLOAT)
    if kinds == [VECTOR] and name in _ENTRYWISE:
        return ex.allocate(f"{_ENTRYWISE[name]}(w, {values[0].code})", VECTOR)
    if kinds == [VECTOR] and name == "argsort":
        return ex.allocate(f"sn_order(w, {values[0].code})", View(1, True))
    raise ex.scope.fail(node, f"there is no translation to C for `{name}` of these.")


def _of_numbers(name: str, codes: list[str]) -> Value | None:
    if len(codes) == 2:
        return Value(f"{_PAIR[name]}({codes[0]}, {codes[1]})", FLOAT) if name in _PAIR else None
    if name in _EACH:
        return Value(f"{_EACH[name]}({codes[0]})", FLOAT)
    if name == "isfinite":
        return Value(f"sn_finite({codes[0]})", BOOL)
    if name in ("floor", "ceil"):
        # A whole number, as in math; numpy's float has the same value.
        return Value(f"sn_int(w, {name}({codes[0]}))", INT)
    return None


def _whole(ex: CallContext, node: ast.AST) -> bool:
    whole = False
    for keyword in node.keywords if isinstance(node, ast.Call) else []:
        name = ast.unparse(keyword.value)
        if keyword.arg != "dtype" or name not in ("np.int64", "np.float64", "int", "float"):
            raise ex.scope.fail(node, "arrays are of float64 or int64.")
        whole = name in ("np.int64", "int")
    return whole


def _new_array(ex: CallContext, node: ast.AST, values: list[Value], *, whole: bool) -> Value:
    """Return a new array; `np.empty` is filled with zeros."""
    if not isinstance(node, ast.Call) or len(node.args) != 1:
        raise ex.scope.fail(node, "one shape is needed.")
    shape = node.args[0]
    if isinstance(shape, ast.Tuple) and len(shape.elts) == 2 and not whole:
        sizes = [ex.scalar(size, INT) for size in shape.elts]
        return ex.allocate(f"sn_zeros2(w, {sizes[0]}, {sizes[1]})", MATRIX)
    if isinstance(shape, ast.Tuple) and len(shape.elts) == 3 and not whole:
        sizes = [ex.scalar(size, INT) for size in shape.elts]
        return ex.allocate(f"sn_zeros3(w, {', '.join(sizes)})", View(3))
    size = values[0]
    if size.type != INT:
        raise ex.scope.fail(node, "arrays are made with one to three dimensions.")
    return ex.allocate(f"sn_zeros{'_i' if whole else '1'}(w, {size.code})", View(1, whole))


def _dot(ex: CallContext, node: ast.AST, values: list[Value]) -> Value:
    a, b = values
    codes = f"(w, {ex.scope.argument(a)}, {ex.scope.argument(b)})"
    if a.type == b.type == VECTOR:
        return Value(f"sn_dot{codes}", FLOAT)
    if a.type == MATRIX and b.type == VECTOR:
        return ex.allocate(f"sn_dot_mv{codes}", VECTOR)
    if a.type == VECTOR and b.type == MATRIX:
        return ex.allocate(f"sn_dot_vm{codes}", VECTOR)
    raise ex.scope.fail(node, "products are supported of vectors, or of a vector and a matrix.")


def array_of(ex: CallContext, node: ast.Call) -> Value:
    """Return `np.array([a, b, ...])` of numbers."""
    items = node.args[0].elts if len(node.args) == 1 and isinstance(node.args[0], ast.List | ast.Tuple) else []
    values = ex.evaluate_all(items)
    if not items or node.keywords or not all(isinstance(value.type, Scalar) for value in values):
        raise ex.scope.fail(node, "`np.array` is supported for a list of numbers.")
    made = ex.allocate(f"sn_zeros1(w, {len(values)})", VECTOR)
    for i, value in enumerate(values):
        ex.scope.emit(f"*sn_at1(w, {made.code}, {i}) = {ex.scope.cast(value, FLOAT)};")
    return made


def method(ex: CallContext, node: ast.Call, name: str, base: Value) -> Value:
    """Return the C of `base.NAME(...)`."""
    if node.keywords or not isinstance(base.type, View) or base.type.whole:
        raise ex.scope.fail(node, "this method is not supported.")
    if name in _REDUCTIONS and not node.args:
        return numpy_call(ex, node, name, [base])
    if name == "copy" and not node.args and base.type.rank < 3:
        return ex.allocate(f"sn_copied{base.type.rank}(w, {ex.scope.argument(base)})", base.type)
    if name == "reshape":
        shape = node.args[0] if len(node.args) == 1 else ast.Tuple(node.args)
        sizes = shape.elts if isinstance(shape, ast.Tuple) else [shape]
        codes = [ex.scalar(size, INT) for size in sizes]
        flat = base.code if base.type == VECTOR else f"sn_flat(w, {ex.scope.argument(base)})"
        if len(codes) == 2 and base.type.rank < 3:
            return ex.allocate(f"sn_shaped(w, {flat}, {codes[0]}, {codes[1]})", MATRIX)
        if len(codes) == 1 and base.type == MATRIX:
            return ex.allocate(flat, VECTOR)
    raise ex.scope.fail(node, "this method is not supported.")


def plain_call(ex: CallContext, node: ast.Call, name: str) -> Value:
    """Return the C of a call of one of Python's own functions."""
    if node.keywords:
        raise ex.scope.fail(node, "keyword arguments are not supported here.")
    values = ex.evaluate_all(node.args)
    kinds = [value.type for value in values]
    if len(values) == 1 and isinstance(kinds[0], Scalar):
        value = values[0]
        if name == "float":
            return Value(ex.scope.cast(value, FLOAT), FLOAT, value.known)
        if name == "bool":
            return Value(ex.truth(value, node), BOOL)
        if name == "int":
            code = f"sn_int(w, {value.code})" if kinds[0] == FLOAT else ex.scope.cast(value, INT)
            return Value(code, INT)
        if name == "abs" and kinds[0] == FLOAT:
            return Value(f"fabs({value.code})", FLOAT)
    if name in ("min", "max") and len(values) > 1 and all(isinstance(kind, Scalar) for kind in kinds):
        kind = FLOAT if FLOAT in kinds else INT
        code = ex.scope.cast(values[0], kind)
        for value in values[1:]:
            code = f"sn_{name}{'' if kind == FLOAT else '_i'}({code}, {ex.scope.cast(value, kind)})"
        return Value(code, kind)
    raise ex.scope.fail(node, "this function is not supported.")
