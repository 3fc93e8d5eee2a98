"""A runtime's `step` as a CasADi function: an interpreter of its text, on numbers where known and symbols elsewhere.

Arrays, parameters, loop bounds and table indices must be known. If a test is on symbols, both branches are interpreted,
each on its own copy of all reachable arrays, and merged entry by entry. A construct without a rule is an error that
names its line.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import numpy as np

from softneck.core import SettingsError, Vector

from ._block import Block
from ._bundle import bundle
from ._casadi_values import Values, as_objects, fill, plain

_CONSTANTS = {"pi": np.pi, "inf": np.inf, "nan": np.nan, "e": np.e}
_WRONG = (ArithmeticError, IndexError, KeyError, TypeError, ValueError, NotImplementedError, RuntimeError)
# Detects endless loops; the longest loop of a step has some hundreds of iterations.
_MOST_ROUNDS = 1_000_000


class Text:
    """The functions and constants that a bundle's text defines."""

    def __init__(self, text: str) -> None:
        """Read `text`."""
        self.lines = text.splitlines()
        body = ast.parse(text).body
        self.functions = {node.name: node for node in body if isinstance(node, ast.FunctionDef)}
        self.constants: dict[str, ast.expr] = {}
        for node in body:
            for target in node.targets if isinstance(node, ast.Assign) else []:
                if isinstance(target, ast.Name) and isinstance(node, ast.Assign):
                    self.constants[target.id] = node.value


class _Return(Exception):
    def __init__(self, value: Any) -> None:
        self.value = value


class _Break(Exception):
    pass


class _Continue(Exception):
    pass


class Walk:
    """Interpreter of the functions of a text; `_frames` holds the variables of the active calls, innermost last."""

    def __init__(self, text: Text) -> None:
        """Create an interpreter of `text`."""
        self._text, self._v = text, Values()
        self._frames: list[dict[str, Any]] = []
        self._names: list[str] = []

    def call(self, name: str, values: Sequence[Any]) -> Any:
        """Interpret a function of the text and return its result."""
        function = self._text.functions[name]
        arguments = [argument.arg for argument in function.args.args]
        self._frames.append(dict(zip(arguments, values, strict=True)))
        self._names.append(name)
        try:
            self._block(function.body)
        except _Return as done:
            return done.value
        finally:
            self._frames.pop()
            self._names.pop()
        return None

    def _fail(self, node: ast.AST, reason: object) -> NoReturn:
        line = getattr(node, "lineno", 0)
        said = self._text.lines[line - 1].strip() if line else ""
        raise SettingsError(
            f"`{self._names[-1]}` cannot become a CasADi function: {reason} (line {line} of its bundle, `{said}`)."
        )

    # Statements

    def _block(self, body: Sequence[ast.stmt]) -> None:
        for node in body:
            handler = getattr(self, f"_{type(node).__name__.lower()}", None)
            if handler is None:
                self._fail(node, f"there is no rule for {type(node).__name__}")
            try:
                handler(node)
            except SettingsError:
                raise
            except _WRONG as error:
                self._fail(node, error)

    def _expr(self, node: ast.Expr) -> None:
        self._value(node.value)

    def _assign(self, node: ast.Assign) -> None:
        value = self._value(node.value)
        for target in node.targets:
            self._store(target, value)

    def _augassign(self, node: ast.AugAssign) -> None:
        before = self._value(node.target)
        after = self._v.operate(node.op, before, self._value(node.value))
        if isinstance(before, np.ndarray):
            # In place, as numpy does: other references to the array see the change.
            before[...] = as_objects(after)
        else:
            self._store(node.target, after)

    def _for(self, node: ast.For) -> None:
        rounds = self._value(node.iter)
        if not isinstance(rounds, range) or node.orelse:
            self._fail(node, "only a loop over `range` is known")
        for item in rounds:
            self._store(node.target, item)
            if not self._goes_on(node.body):
                break

    def _while(self, node: ast.While) -> None:
        for _ in range(_MOST_ROUNDS):
            if not self._known_value(node.test) or not self._goes_on(node.body):
                return
        self._fail(node, "this loop does not end")

    def _goes_on(self, body: list[ast.stmt]) -> bool:
        """Interpret the body of a loop once; return False after `break`."""
        try:
            self._block(body)
        except _Break:
            return False
        except _Continue:
            return True
        return True

    def _return(self, node: ast.Return) -> None:
        raise _Return(None if node.value is None else self._value(node.value))

    def _break(self, _: ast.Break) -> None:
        raise _Break

    def _continue(self, _: ast.Continue) -> None:
        raise _Continue

    def _if(self, node: ast.If) -> None:
        test = self._value(node.test)
        if not self._v.symbolic(test):
            self._block(node.body if test else node.orelse)
            return
        before = self._reach()
        start = [array.copy() for array in before]
        variables = self._frames[-1]
        branches = []
        for condition, body in ((test, node.body), (self._v.inverse(test), node.orelse)):
            self._frames[-1] = dict(variables)
            for array, entries in zip(before, start, strict=True):
                array[...] = entries
            with self._under(condition):
                self._branch(node, body)
            branches.append((self._frames[-1], [array.copy() for array in before]))
        (yes, first), (no, second) = branches
        for array, a, b in zip(before, first, second, strict=True):
            array[...] = as_objects(self._v.choose(test, a, b))
        # A variable that only one branch defines is undefined after the `if`; a later use raises an error.
        self._frames[-1] = {
            name: self._merge(node, test, yes[name], no[name], before) for name in yes if name in no
        }  # fmt: skip

    def _branch(self, node: ast.AST, body: list[ast.stmt]) -> None:
        try:
            self._block(body)
        except (_Return, _Break, _Continue):
            self._fail(node, "a test on symbols decides on `return`, `break` or `continue`")

    def _merge(self, node: ast.AST, test: Any, yes: Any, no: Any, before: list[np.ndarray]) -> Any:
        """Return a variable's value after a test; arrays that existed before it have been merged in place."""
        there = {id(array) for array in before}
        held = any(isinstance(value, np.ndarray) and id(_root(value)) in there for value in (yes, no))
        if held and yes is not no:
            self._fail(node, "a test on symbols decides which array a name stands for")
        return self._v.choose(test, yes, no)

    @contextmanager
    def _under(self, condition: Any) -> Iterator[None]:
        before, self._v.under = self._v.under, self._v.both(self._v.under, condition)
        try:
            yield
        finally:
            self._v.under = before

    def _reach(self) -> list[np.ndarray]:
        """Return the arrays that own the data of all variables of all frames, also of those that are views."""
        found: dict[int, np.ndarray] = {}
        waiting = [value for frame in self._frames for value in frame.values()]
        while waiting:
            value = waiting.pop()
            if isinstance(value, tuple):
                waiting += value
            elif isinstance(value, np.ndarray) and value.dtype == object:
                found[id(_root(value))] = _root(value)
        return list(found.values())

    # Targets

    def _store(self, target: ast.expr, value: Any) -> None:
        if isinstance(target, ast.Name):
            self._frames[-1][target.id] = value
        elif isinstance(target, ast.Tuple):
            for part, item in zip(target.elts, value, strict=True):
                self._store(part, item)
        elif isinstance(target, ast.Subscript):
            array, place = self._value(target.value), self._place(target.slice)
            part = array[place]
            if isinstance(part, np.ndarray):
                part[...] = as_objects(value)
            else:
                array[place] = plain(value)
        else:
            self._fail(target, "nothing can be assigned to this")

    # Expressions

    def _value(self, node: ast.expr) -> Any:
        handler = getattr(self, f"_{type(node).__name__.lower()}", None)
        if handler is None:
            self._fail(node, f"there is no rule for {type(node).__name__}")
        return handler(node)

    def _known_value(self, node: ast.expr) -> Any:
        """Return the value of an expression; raise an error if it is a symbol."""
        return self._number(node, self._value(node))

    def _number(self, node: ast.expr, value: Any) -> Any:
        if self._v.symbolic(value):
            self._fail(node, f"`{ast.unparse(node)}` depends on state or inputs, and must be known here")
        return value

    def _constant(self, node: ast.Constant) -> Any:
        return node.value

    def _name(self, node: ast.Name) -> Any:
        if node.id in self._frames[-1]:
            return self._frames[-1][node.id]
        if node.id in self._text.constants:
            return self._value(self._text.constants[node.id])
        return self._fail(node, f"`{node.id}` is not defined, or not on every path to here")

    def _attribute(self, node: ast.Attribute) -> Any:
        if isinstance(node.value, ast.Name) and node.value.id in ("np", "math") and node.attr in _CONSTANTS:
            return _CONSTANTS[node.attr]
        value = self._value(node.value)
        if node.attr not in ("shape", "size", "T"):
            self._fail(node, f"the attribute `{node.attr}` is not known")
        return getattr(value, node.attr)

    def _tuple(self, node: ast.Tuple) -> tuple[Any, ...]:
        return tuple(self._value(item) for item in node.elts)

    def _subscript(self, node: ast.Subscript) -> Any:
        return plain(self._value(node.value)[self._place(node.slice)])

    def _place(self, node: ast.expr) -> Any:
        if isinstance(node, ast.Slice):
            ends = (node.lower, node.upper, node.step)
            return slice(*(None if end is None else self._known_value(end) for end in ends))
        if isinstance(node, ast.Tuple):
            return tuple(self._place(item) for item in node.elts)
        return self._known_value(node)

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        value = self._value(node.operand)
        if isinstance(node.op, ast.Not):
            return self._v.inverse(value) if self._v.symbolic(value) else not value
        if not isinstance(node.op, ast.USub):
            self._fail(node, "this operator is not known")
        return self._v.operate(ast.Mult(), -1, value)

    def _binop(self, node: ast.BinOp) -> Any:
        return self._v.operate(node.op, self._value(node.left), self._value(node.right))

    def _compare(self, node: ast.Compare) -> Any:
        values = [self._value(item) for item in (node.left, *node.comparators)]
        pairs = zip(node.ops, values, values[1:], strict=False)
        return self._combine(True, (self._v.operate(op, left, right) for op, left, right in pairs))

    def _boolop(self, node: ast.BoolOp) -> Any:
        return self._combine(isinstance(node.op, ast.And), (self._value(part) for part in node.values))

    def _combine(self, conjunction: bool, values: Iterator[Any]) -> Any:
        """Return the conjunction or disjunction of conditions; as in Python, a known result skips the rest."""
        result: Any = conjunction
        for value in values:
            if not self._v.symbolic(value):
                if bool(value) is not conjunction:
                    return not conjunction
            elif not self._v.symbolic(result):
                result = value
            else:
                result = self._v.both(result, value) if conjunction else self._v.either(result, value)
        return result

    def _ifexp(self, node: ast.IfExp) -> Any:
        test = self._value(node.test)
        if not self._v.symbolic(test):
            return self._value(node.body if test else node.orelse)
        with self._under(test):
            yes = self._value(node.body)
        with self._under(self._v.inverse(test)):
            no = self._value(node.orelse)
        return self._v.choose(test, yes, no)

    # Calls

    def _call(self, node: ast.Call) -> Any:
        if node.keywords:
            self._fail(node, "arguments by name are not known")
        values = [self._value(item) for item in node.args]
        name = ast.unparse(node.func)
        if name in self._text.functions:
            return self.call(name, values)
        owner, _, last = name.rpartition(".")
        if owner in ("np", "math"):
            return self._library(node, last, values)
        if owner == "":
            return self._builtin(node, name, values)
        if isinstance(node.func, ast.Attribute) and not values and last == "copy":
            return as_objects(self._value(node.func.value))
        return self._fail(node, f"the method `{last}` is not known")

    def _builtin(self, node: ast.Call, name: str, values: list[Any]) -> Any:
        if name in ("min", "max"):
            return self._v.extreme(f"f{name}", values)
        if name == "abs":
            return self._v.call("fabs", *values)
        if name == "float" and self._v.symbolic(values[0]):
            return values[0]
        if name not in _BUILTINS:
            self._fail(node, f"the function `{name}` is not known")
        return _BUILTINS[name](*(self._number(item, value) for item, value in zip(node.args, values, strict=True)))

    def _library(self, node: ast.Call, name: str, values: list[Any]) -> Any:
        if name in ("empty", "zeros"):
            # Reading an entry that was never written is an error, as None has no arithmetic.
            return np.full(values[0], None if name == "empty" else 0.0, dtype=object)
        if name in ("min", "max"):
            return self._v.extreme(f"f{name}", list(values[0].flat))
        if name in ("dot", "sort"):
            return getattr(self._v, name)(*values)
        if name == "isfinite":
            return bool(np.isfinite(self._number(node.args[0], values[0])))
        return self._v.call(name, *values)


def _root(array: np.ndarray) -> np.ndarray:
    """Return the array that holds the entries of a view."""
    return array if array.base is None else _root(array.base)


_BUILTINS = {"int": int, "float": float, "bool": bool, "range": range}


def step_function(block: Block, parameters: Vector, inputs: int) -> Any:
    """Return `casadi.Function` x, u -> x_next, y: one `step` of `block`.

    Args:
        block: whose runtime is interpreted.
        parameters: numbers, in the block's order.
        inputs: number of inputs that are symbols u; the others are missing (NaN).

    Raises SettingsError: the text has a construct that symbols do not allow; the message names function and line.
    """
    import casadi as ca

    size = block.initial_state().values.size
    x, u = ca.SX.sym("x", size), ca.SX.sym("u", inputs)
    state = fill(np.empty(size, dtype=object), [x[i] for i in range(size)])
    given = [u[i] for i in range(inputs)] + [np.nan] * (len(block.inputs) - inputs)
    outputs = np.zeros(len(block.outputs)).astype(object)
    arrays = tuple(_read_only(array) for array in block.arrays)
    text = Text(bundle(block.runtime, loops=False))
    Walk(text).call("step", [arrays, _read_only(parameters), state, as_objects(np.array(given, dtype=object)), outputs])
    return ca.Function(block.kind, [x, u], [ca.vertcat(*state), ca.vertcat(*outputs)], ["x", "u"], ["x_next", "y"])


def _read_only(array: np.ndarray) -> np.ndarray:
    view = np.asarray(array, dtype=np.float64).view()
    view.flags.writeable = False
    return view
