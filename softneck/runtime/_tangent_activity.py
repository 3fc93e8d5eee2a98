"""Activity analysis: which variables of a runtime's function depend on state or inputs, and their number of dimensions.

Only these active variables have tangents. The analysis treats a function as a whole, ignoring the order of its
statements, once for each set of active arguments; whole numbers and tests are never active.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import product

from softneck.core import SettingsError

# Random numbers do not depend on state or inputs.
RANDOM = re.compile(r"(m\d+_)*random_\w+")
_MEMBERS_NAME = re.compile(r"^(m\d+_)+")
# Functions that create arrays; functions that are piecewise constant and have no derivative.
MAKERS = ("empty", "zeros")
STEPS = ("int", "bool", "floor", "ceil", "isfinite")
# A search among data `low, high = f(..., w)` is differentiated by the text's own `f_slopes(..., w, low, high, slopes)`.
SLOPES = "_slopes"

# Stand-in for a member that is not in the text: its outputs and state depend on state and inputs.
MEMBER_STEP = "member_step"
MEMBER_START = "member_initialise"
_MEMBER_SOURCE = """
def member_step(arrays, member, parameters, state, inputs, outputs):
    state[0] = state[0] + inputs[0]
    outputs[0] = state[0]
"""

# Function of a runtime without derivative -> the reason.
_WITHOUT = {
    "qp_solve": "it solves a quadratic program by iterations that are not differentiated.",
    "adaptive_update": "it learns its plant while it runs, with a covariance that is not differentiated.",
    "kalman_predict": "it carries a covariance, which is not differentiated.",
    "payload_start": "it carries several models and their spread, which are not differentiated.",
    "neck_substeps": "the virtual neck's integration is not differentiated; a model identified on it is.",
}
# Up to this number of products in one function, all choices of dimensions are tried.
_MOST_PRODUCTS = 6

# Active arguments, each with its number of dimensions.
Pattern = tuple[tuple[str, int], ...]


class TangentError(SettingsError):
    """A runtime uses a function or construct without a derivative."""


class Program:
    """The functions of a bundle, with the activity of each for each pattern of arguments.

    Attributes:
        functions: by name.
        has_members: whether it calls members that are not in the text.
    """

    def __init__(self, text: str) -> None:
        """Read the bundle `text`."""
        tree = ast.parse(text)
        self.functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
        stub = self.functions.get(MEMBER_STEP)
        self.has_members = stub is not None and isinstance(stub.body[-1], ast.Raise)
        if self.has_members:
            self.functions |= {
                node.name: node for node in ast.parse(_MEMBER_SOURCE).body if isinstance(node, ast.FunctionDef)
            }
        for name in self.functions:
            reason = _WITHOUT.get(_MEMBERS_NAME.sub("", name))
            if reason is not None:
                raise TangentError(reason)
        self._done: dict[tuple[str, Pattern], Activity] = {}
        self._open: set[tuple[str, Pattern]] = set()

    def activity(self, name: str, pattern: Pattern) -> Activity:
        """Return the activity of a function with the active arguments `pattern`."""
        key = (name, pattern)
        if key in self._open:
            raise TangentError(f"{name}: a function that calls itself has no known derivative.")
        if key not in self._done:
            self._open.add(key)
            try:
                self._done[key] = Activity(self, self.functions[name], pattern)
            finally:
                self._open.discard(key)
        return self._done[key]

    def search_name(self, node: ast.AST) -> str | None:
        """Return the name of this text's function with slopes that `node` calls; None for others."""
        name = self.callee_name(node)
        return name if name is not None and name + SLOPES in self.functions else None

    def callee_name(self, node: ast.AST) -> str | None:
        """Return the name of this text's function that `node` calls; None for others and random numbers."""
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in self.functions:
            return None if RANDOM.fullmatch(node.func.id) else node.func.id
        return None


class Activity:
    """The active variables of one function.

    Attributes:
        node: the function.
        active: names of variables; views by the name of their array.
        ranks: dimensions of names: 0 for numbers.
        roots: name of a view -> name of its array.
        result: whether the returned value is active.
    """

    def __init__(self, program: Program, node: ast.FunctionDef, pattern: Pattern) -> None:
        """Analyse `node`."""
        self.program, self.node = program, node
        self.parameters = [argument.arg for argument in node.args.args]
        self.active = {name for name, _ in pattern}
        self.ranks: dict[str, int] = dict(pattern)
        for argument in node.args.args:
            if argument.annotation is not None and ast.unparse(argument.annotation) in ("float", "int", "bool"):
                self.ranks.setdefault(argument.arg, 0)
        self.roots: dict[str, str] = {}
        self.result = False
        self.products: dict[int, int] = {}
        self._statements = list(statements(node.body))
        self._choose_products()
        before = -1
        while before != (before := len(self.active) + len(self.ranks) + len(self.roots) + self.result):
            for statement in self._statements:
                self._look(statement)

    @property
    def written(self) -> dict[str, int]:
        """The active arguments, including those that the function makes active."""
        return {name: self.ranks.get(name, 1) for name in self.parameters if name in self.active}

    @property
    def makes_vector(self) -> bool:
        """Whether the function returns an array."""
        return self.node.returns is not None and ast.unparse(self.node.returns) == "np.ndarray"

    @property
    def numbers(self) -> tuple[str, ...]:
        """The types of the results of a function that returns several; empty for one result."""
        returns = self.node.returns
        if isinstance(returns, ast.Subscript) and isinstance(returns.slice, ast.Tuple):
            return tuple(map(ast.unparse, returns.slice.elts)) if ast.unparse(returns.value) == "tuple" else ()
        return ()

    @property
    def stores(self) -> set[str]:
        """The arguments that the function writes into."""
        found = set()
        for part in ast.walk(self.node):
            base = viewed_name(part) if isinstance(part, ast.Subscript) and isinstance(part.ctx, ast.Store) else None
            found |= {self.root(base.id)} if base is not None else set()
            name = self.program.callee_name(part)
            if name is not None and isinstance(part, ast.Call):
                callee = self.program.activity(name, self.pattern(part, name))
                for parameter, value in zip(callee.parameters, part.args, strict=True):
                    base = viewed_name(value)
                    found |= {self.root(base.id)} if base is not None and parameter in callee.stores else set()
        return found & set(self.parameters)

    def root(self, name: str) -> str:
        """Return the array of a view."""
        while name in self.roots:
            name = self.roots[name]
        return name

    def is_active(self, node: ast.AST) -> bool:
        """Return whether an expression is active."""
        if isinstance(node, ast.Name):
            return self.root(node.id) in self.active
        if isinstance(node, ast.Compare | ast.BoolOp | ast.Constant | ast.Slice):
            return False
        if isinstance(node, ast.Subscript):
            return self.is_active(node.value)
        if isinstance(node, ast.Attribute):
            return node.attr not in ("shape", "size", "ndim") and self.is_active(node.value)
        if isinstance(node, ast.IfExp):
            return self.is_active(node.body) or self.is_active(node.orelse)
        if isinstance(node, ast.Call):
            return self._call_is_active(node)
        return any(self.is_active(child) for child in ast.iter_child_nodes(node))

    def rank(self, node: ast.AST) -> int | None:
        """Return the number of dimensions of an expression; None if it cannot be determined."""
        if isinstance(node, ast.Name):
            return self.ranks.get(node.id)
        if isinstance(node, ast.Constant | ast.Compare | ast.BoolOp):
            return 0
        if isinstance(node, ast.Subscript):
            base = self.rank(node.value)
            places = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
            return None if base is None else base - sum(not isinstance(place, ast.Slice) for place in places)
        if isinstance(node, ast.Attribute):
            return self.rank(node.value) if node.attr == "T" else 0
        if isinstance(node, ast.BinOp | ast.UnaryOp | ast.IfExp):
            parts = [node.left, node.right] if isinstance(node, ast.BinOp) else []
            parts += [node.operand] if isinstance(node, ast.UnaryOp) else []
            parts += [node.body, node.orelse] if isinstance(node, ast.IfExp) else []
            known = [rank for rank in map(self.rank, parts) if rank is not None]
            return max(known) if known else None
        return self._call_rank(node) if isinstance(node, ast.Call) else None

    def fail(self, node: ast.AST, text: str) -> TangentError:
        """Return the error that names function and line."""
        shown = ast.unparse(node).splitlines()[0][:80] if isinstance(node, ast.expr | ast.stmt) else ""
        return TangentError(f"{self.node.name}: `{shown}`: {text}")

    def pattern(self, call: ast.Call, name: str) -> Pattern:
        """Return the active arguments of a call, with their numbers of dimensions."""
        names = [argument.arg for argument in self.program.functions[name].args.args]
        if call.keywords or len(call.args) != len(names):
            raise self.fail(call, "arguments are given by position, all of them.")
        found: dict[str, int] = {}
        for parameter, value in zip(names, call.args, strict=True):
            if self.is_active(value):
                rank = self.rank(value)
                if rank is None and isinstance(value, ast.Name) and value.id in self.parameters:
                    rank = 1  # an output argument: the analysis of the caller corrects it
                if rank is None:
                    raise self.fail(call, f"the number of dimensions of `{ast.unparse(value)}` cannot be determined.")
                found[parameter] = rank
        return tuple(found.items())

    def _call_is_active(self, node: ast.Call) -> bool:
        function = node.func
        if isinstance(function, ast.Attribute):
            if isinstance(function.value, ast.Name) and function.value.id in ("np", "math"):
                quiet = function.attr in (*STEPS, *MAKERS)
                return not quiet and any(self.is_active(value) for value in node.args)
            return self.is_active(function.value) or any(self.is_active(value) for value in node.args)
        name = self.program.callee_name(node)
        if self.program.search_name(node):
            return self.is_active(node.args[-1])
        if name is not None:
            pattern = self.pattern(node, name)
            return bool(pattern) and self.program.activity(name, pattern).result
        if isinstance(function, ast.Name) and (function.id in STEPS or function.id in self.program.functions):
            return False
        return any(self.is_active(value) for value in node.args)

    def _call_rank(self, node: ast.Call) -> int | None:
        function = node.func
        if isinstance(function, ast.Attribute):
            numpy = isinstance(function.value, ast.Name) and function.value.id in ("np", "math")
            if not numpy:
                return self.rank(function.value) if function.attr == "copy" else None
            if function.attr in ("empty", "zeros", "ones"):
                return len(node.args[0].elts) if isinstance(node.args[0], ast.Tuple) else 1
            if function.attr == "dot":
                return self.products.get(id(node))
            return self.rank(node.args[0]) if node.args else None
        name = self.program.callee_name(node)
        returns = self.program.functions[name].returns if name else None
        if returns is not None:
            return {"float": 0, "int": 0, "bool": 0, "np.ndarray": 1}.get(ast.unparse(returns))
        return 0

    def _look(self, statement: ast.stmt) -> None:
        """Update the activity by one statement."""
        if isinstance(statement, ast.For) and isinstance(statement.target, ast.Name):
            self.ranks[statement.target.id] = 0
        if isinstance(statement, ast.Return) and statement.value is not None:
            self.result |= self.is_active(statement.value)
        if isinstance(statement, ast.Assign):
            for target in statement.targets:
                for place, (one, value) in enumerate(pairs(target, statement.value)):
                    self._bind(one, value)
                    if value is None and self.is_active(statement.value) and self._is_number(statement.value, place):
                        self._mark(one, True)
                        self.ranks[ast.unparse(one)] = 0
        elif isinstance(statement, ast.AugAssign):
            self._mark(statement.target, self.is_active(statement.value))
            rank = self.rank(statement.value)
            if isinstance(statement.target, ast.Name) and rank is not None:  # scalars are not broadcast
                self.ranks.setdefault(statement.target.id, rank)
        for call in calls(statement):
            name = None if self.program.search_name(call) else self.program.callee_name(call)
            pattern = self.pattern(call, name) if name else ()
            if not name or not pattern:
                continue
            names = [argument.arg for argument in self.program.functions[name].args.args]
            written = self.program.activity(name, pattern).written
            for parameter, value in zip(names, call.args, strict=True):
                if parameter in written and self.rank(value) != 0:
                    self._mark(value, True)

    def _is_number(self, call: ast.expr, place: int) -> bool:
        """Return whether one of several results of a call is a float, and so may be active."""
        name = self.program.callee_name(call)
        if name is None or self.program.search_name(call) or not isinstance(call, ast.Call):
            return True
        kinds = self.program.activity(name, self.pattern(call, name)).numbers
        return not kinds or kinds[place] == "float"

    def _bind(self, target: ast.expr, value: ast.expr | None) -> None:
        if value is None:
            return
        if isinstance(target, ast.Name):
            rank = self.rank(value)
            if rank is not None:
                self.ranks[target.id] = max(rank, self.ranks.get(target.id, 0))
            base = viewed_name(value)
            if base is not None and rank and base.id != target.id and self.root(base.id) != target.id:
                self.roots[target.id] = base.id
        self._mark(target, self.is_active(value))

    def _mark(self, target: ast.expr, active: bool) -> None:
        while isinstance(target, ast.Subscript | ast.Attribute | ast.Call):
            inner = target.func if isinstance(target, ast.Call) else target.value
            target = inner
        if active and isinstance(target, ast.Name):
            self.active.add(self.root(target.id))

    def _choose_products(self) -> None:
        """Choose the number of dimensions of each `np.dot`: the only consistent choice, or vectors if several are."""
        nodes = [part for part in ast.walk(self.node) if is_numpy(part, "dot")]
        if not nodes:
            return
        vectors = (1,) * len(nodes)
        fitting = []
        for choice in product((0, 1), repeat=len(nodes)) if len(nodes) <= _MOST_PRODUCTS else [vectors]:
            self.products = dict(zip(map(id, nodes), choice, strict=True))
            ranks = dict(self.ranks)
            for _ in range(2):
                for statement in self._statements:
                    if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
                        rank = self.rank(statement.value)
                        if rank is not None:
                            self.ranks[statement.targets[0].id] = rank
            if self._fits(nodes):
                fitting.append(choice)
            self.ranks = ranks
        chosen = fitting[0] if len(fitting) == 1 else vectors if vectors in fitting else ()
        self.products = dict(zip(map(id, nodes), chosen, strict=False))

    def _fits(self, nodes: list[ast.AST]) -> bool:
        dots = all(self.rank(value) in (None, 1, 2) for node in nodes for value in node.args)  # type: ignore[attr-defined]
        returns = ast.unparse(self.node.returns) if self.node.returns else ""
        numbers = returns != "float" or all(
            self.rank(s.value) in (None, 0) for s in self._statements if isinstance(s, ast.Return) and s.value
        )
        return dots and numbers


def statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield statements and the statements inside them, in order."""
    for statement in body:
        yield statement
        for part in ("body", "orelse"):
            yield from statements(getattr(statement, part, []))


def calls(statement: ast.stmt) -> list[ast.Call]:
    """Return the calls of a statement itself, without those of statements inside it."""
    own = [child for child in ast.iter_child_nodes(statement) if not isinstance(child, ast.stmt)]
    return [part for child in own for part in ast.walk(child) if isinstance(part, ast.Call)]


def pairs(target: ast.expr, value: ast.expr) -> list[tuple[ast.expr, ast.expr | None]]:
    """Return each target of an assignment with its value; None if one call returns several values."""
    if isinstance(target, ast.Tuple):
        values = value.elts if isinstance(value, ast.Tuple) else [None] * len(target.elts)
        return list(zip(target.elts, values, strict=True))
    return [(target, value)]


def viewed_name(node: ast.expr) -> ast.Name | None:
    """Return the name of the array that an expression views; None for a copy or a number."""
    while isinstance(node, ast.Subscript):
        node = node.value
    return node if isinstance(node, ast.Name) else None


def is_numpy(node: ast.AST, *names: str) -> bool:
    """Return whether `node` is a call of one of numpy's or math's functions `names`."""
    function = node.func if isinstance(node, ast.Call) else None
    return (
        isinstance(function, ast.Attribute)
        and isinstance(function.value, ast.Name)
        and function.value.id in ("np", "math")
        and (not names or function.attr in names)
    )
