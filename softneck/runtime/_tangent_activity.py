"""Which variables of a runtime's function depend on its state or inputs, and how many dimensions they have.

Only those carry rows of derivatives. The analysis looks at a function as a whole, without the order of its
statements, once for each set of arguments that depend on them; whole numbers and tests never do.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import product

from softneck.core import SettingsError

# Draws of random numbers are taken as they come: nothing moves them.
RANDOM = re.compile(r"(m\d+_)*random_\w+")
_MEMBERS_NAME = re.compile(r"^(m\d+_)+")
# Of arrays: what makes a new one. Of numbers: what is a step in any case, and has no derivative.
MAKERS = ("empty", "zeros", "ones", "empty_like", "zeros_like")
STEPS = ("int", "bool", "len", "floor", "ceil", "round", "isfinite", "isnan", "isinf")
# `low, high = f(..., w)` of a search among data is derived by the text's own `f_slopes(..., w, low, high, slopes)`.
SLOPES = "_slopes"

# A member that is not in the text: what is known of it is that its outputs and state follow from state and inputs.
MEMBER_STEP = "member_step"
MEMBER_START = "member_initialise"
_MEMBER = """
def member_step(arrays, member, parameters, state, inputs, outputs):
    state[0] = state[0] + inputs[0]
    outputs[0] = state[0]
"""

# What has no derivative yet, by one of its functions, and why.
_WITHOUT = {
    "qp_solve": "it solves a quadratic program by iterations that are not differentiated.",
    "adaptive_update": "it learns its plant while it runs, with a covariance that is not differentiated.",
    "kalman_predict": "it carries a covariance, which is not differentiated.",
    "payload_start": "it carries several models and their spread, which are not differentiated.",
    "neck_substeps": "the virtual neck's integration is not differentiated; a model identified on it is.",
}
# All choices of dimensions are tried for so many products in one function.
_MOST_PRODUCTS = 6

# Argument -> number of its dimensions, for those that depend on state or inputs.
Pattern = tuple[tuple[str, int], ...]


class TangentError(SettingsError):
    """A runtime uses something that has no derivative, or none that is known here."""


class Program:
    """The functions of a bundle, and what is known of each with each pattern of arguments.

    Attributes:
        functions: by name.
        has_members: whether it calls members whose text is elsewhere.
    """

    def __init__(self, text: str) -> None:
        """Read the bundle `text`."""
        tree = ast.parse(text)
        self.functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
        stub = self.functions.get(MEMBER_STEP)
        self.has_members = stub is not None and isinstance(stub.body[-1], ast.Raise)
        if self.has_members:
            self.functions |= {node.name: node for node in ast.parse(_MEMBER).body if isinstance(node, ast.FunctionDef)}
        for name in self.functions:
            reason = _WITHOUT.get(_MEMBERS_NAME.sub("", name))
            if reason is not None:
                raise TangentError(reason)
        self._done: dict[tuple[str, Pattern], Activity] = {}
        self._open: set[tuple[str, Pattern]] = set()

    def activity(self, name: str, pattern: Pattern) -> Activity:
        """Return the activity of a function whose arguments of `pattern` depend on state or inputs."""
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

    def searched(self, node: ast.AST) -> str | None:
        """Return the name of this text's own search that `node` calls: one with slopes of its own."""
        name = self.called(node)
        return name if name is not None and name + SLOPES in self.functions else None

    def called(self, node: ast.AST) -> str | None:
        """Return the name of this text's own function that `node` calls, draws of random numbers aside."""
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in self.functions:
            return None if RANDOM.fullmatch(node.func.id) else node.func.id
        return None


class Activity:
    """What depends on state or inputs in one function.

    Attributes:
        node: the function.
        active: names of variables, arrays by what they are a view of.
        ranks: dimensions of names: 0 for numbers.
        roots: name of a view -> name of the array that it shows.
        result: whether what the function returns depends on them.
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
        """The arguments that depend on state or inputs, those that the function makes so among them."""
        return {name: self.ranks.get(name, 1) for name in self.parameters if name in self.active}

    @property
    def makes_vector(self) -> bool:
        """Whether the function returns an array."""
        return self.node.returns is not None and ast.unparse(self.node.returns) == "np.ndarray"

    @property
    def numbers(self) -> tuple[str, ...]:
        """The types of the several results that the function returns; none for one result."""
        returns = self.node.returns
        if isinstance(returns, ast.Subscript) and isinstance(returns.slice, ast.Tuple):
            return tuple(map(ast.unparse, returns.slice.elts)) if ast.unparse(returns.value) == "tuple" else ()
        return ()

    @property
    def stores(self) -> set[str]:
        """The arguments that the function writes into."""
        found = set()
        for part in ast.walk(self.node):
            base = viewed(part) if isinstance(part, ast.Subscript) and isinstance(part.ctx, ast.Store) else None
            found |= {self.root(base.id)} if base is not None else set()
            name = self.program.called(part)
            if name is not None and isinstance(part, ast.Call):
                callee = self.program.activity(name, self.pattern(part, name))
                for parameter, value in zip(callee.parameters, part.args, strict=True):
                    base = viewed(value)
                    found |= {self.root(base.id)} if base is not None and parameter in callee.stores else set()
        return found & set(self.parameters)

    def root(self, name: str) -> str:
        """Return the array that a name shows."""
        while name in self.roots:
            name = self.roots[name]
        return name

    def is_active(self, node: ast.AST) -> bool:
        """Return whether the value of an expression depends on state or inputs."""
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
        """Return the dimensions of an expression; None where they cannot be told."""
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
        """Return which arguments of a call depend on state or inputs, and their dimensions."""
        names = [argument.arg for argument in self.program.functions[name].args.args]
        if call.keywords or len(call.args) != len(names):
            raise self.fail(call, "arguments are given by position, all of them.")
        found: dict[str, int] = {}
        for parameter, value in zip(names, call.args, strict=True):
            if self.is_active(value):
                rank = self.rank(value)
                if rank is None and isinstance(value, ast.Name) and value.id in self.parameters:
                    rank = 1  # one that is written into: whoever calls knows better and comes again
                if rank is None:
                    raise self.fail(call, f"how many dimensions `{ast.unparse(value)}` has cannot be told.")
                found[parameter] = rank
        return tuple(found.items())

    def _call_is_active(self, node: ast.Call) -> bool:
        function = node.func
        if isinstance(function, ast.Attribute):
            if isinstance(function.value, ast.Name) and function.value.id in ("np", "math"):
                quiet = function.attr in (*STEPS, *MAKERS)
                return not quiet and any(self.is_active(value) for value in node.args)
            return self.is_active(function.value) or any(self.is_active(value) for value in node.args)
        name = self.program.called(node)
        if self.program.searched(node):
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
        name = self.program.called(node)
        returns = self.program.functions[name].returns if name else None
        if returns is not None:
            return {"float": 0, "int": 0, "bool": 0, "np.ndarray": 1}.get(ast.unparse(returns))
        return 0

    def _look(self, statement: ast.stmt) -> None:
        """Follow one statement."""
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
            if isinstance(statement.target, ast.Name) and rank is not None:  # a number is never spread over an array
                self.ranks.setdefault(statement.target.id, rank)
        for call in calls(statement):
            name = None if self.program.searched(call) else self.program.called(call)
            pattern = self.pattern(call, name) if name else ()
            if not name or not pattern:
                continue
            names = [argument.arg for argument in self.program.functions[name].args.args]
            written = self.program.activity(name, pattern).written
            for parameter, value in zip(names, call.args, strict=True):
                if parameter in written and self.rank(value) != 0:
                    self._mark(value, True)

    def _is_number(self, call: ast.expr, place: int) -> bool:
        """Return whether one of several results of a call may be moved: no whole number, no test."""
        name = self.program.called(call)
        if name is None or self.program.searched(call) or not isinstance(call, ast.Call):
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
            base = viewed(value)
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
        """Find how many dimensions each `np.dot` has: the one choice with which all fit, or vectors where many do."""
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
    """Go through statements and those within them, in order."""
    for statement in body:
        yield statement
        for part in ("body", "orelse"):
            yield from statements(getattr(statement, part, []))


def calls(statement: ast.stmt) -> list[ast.Call]:
    """Return the calls of a statement itself, not of statements within it."""
    own = [child for child in ast.iter_child_nodes(statement) if not isinstance(child, ast.stmt)]
    return [part for child in own for part in ast.walk(child) if isinstance(part, ast.Call)]


def pairs(target: ast.expr, value: ast.expr) -> list[tuple[ast.expr, ast.expr | None]]:
    """Return each target of an assignment with its value; None beside what a call returns several of."""
    if isinstance(target, ast.Tuple):
        values = value.elts if isinstance(value, ast.Tuple) else [None] * len(target.elts)
        return list(zip(target.elts, values, strict=True))
    return [(target, value)]


def viewed(node: ast.expr) -> ast.Name | None:
    """Return the name of which an expression is a view; None for a copy or a number."""
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
