"""What the walk through a runtime's text makes of Python on symbols, held against Python itself on numbers."""

from __future__ import annotations

import textwrap
from typing import Any

import casadi as ca
import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.runtime._casadi_values import as_objects
from softneck.runtime._casadi_walk import Text, Walk

AT = (-1.5, 0.0, 0.3, 2.0)


def walked(text: str) -> ca.Function:
    """Return f(a, b) of a text as a function of CasADi."""
    symbols = [ca.SX.sym(name) for name in "ab"]
    result: Any = Walk(Text(textwrap.dedent(text))).call("f", symbols)
    return ca.Function("f", symbols, [ca.vertcat(*(result if isinstance(result, tuple) else (result,)))])


def run(text: str, a: float, b: float) -> np.ndarray:
    """Return f(a, b) by Python."""
    room: dict[str, Any] = {}
    code = compile("import math\nimport numpy as np\n" + textwrap.dedent(text), "text", "exec")
    exec(code, room)
    return np.atleast_1d(room["f"](a, b))


ALIAS = """
    def push(part, value):
        part[1:] = part[:-1].copy()
        part[0] = value

    def f(a, b):
        state = np.zeros(6)
        tail = state[2:]
        push(tail, a)
        push(tail[1:3], b)
        tail += 1.0
        return state[2], state[3], state[4], state[5]
    """
BRANCH = """
    LIMIT = 0.5

    def f(a, b):
        x = np.zeros(3)
        part = x[1:]
        y = 2.0
        if a > LIMIT:
            part[0] = a / b if abs(b) > 0.1 else a
            y += 1.0
        elif b > 0.0:
            part *= b
            if a < 0.0 and b > 1.0:
                y = a
        return x[0], x[1], x[2], y
    """
MANY = """
    def pair(x):
        return np.tanh(x), x - 1.0

    def f(a, b):
        m = np.zeros(2)
        m[0] = a
        m[1] = b
        low, high = pair(a)
        total = 0.0
        for i in range(4):
            if i == 1:
                continue
            if i == 3:
                break
            total += i * a
        row = np.sort(m)
        k = 0
        while k < 2:
            k += 1
        return low, high, total, row[0], np.dot(m, m), max(a, b, 0.1), np.hypot(a, b), k, -a ** 2, not (a < 0.0 < b)
    """


@pytest.mark.parametrize("text", [ALIAS, BRANCH, MANY.replace("np.array_of(a, b)", "np.zeros(2); m[0] = a; m[1] = b")])
def test_symbols_mean_what_numbers_do(text: str) -> None:
    f = walked(text)
    for a in AT:
        for b in AT:
            # Rounding of tanh and roots in two libraries.
            np.testing.assert_allclose(np.array(f(a, b))[:, 0], run(text, a, b), rtol=1e-14, atol=1e-14)


def test_the_branch_not_taken_leaves_no_trace_in_derivatives() -> None:
    f = walked("def f(a, b):\n    return math.sin(a) / a if abs(a) > 1e-9 else 1.0, math.sqrt(a * a + b * b)")
    slope = f.jacobian()(0.0, 0.0, 0.0)
    assert np.isfinite(np.array(ca.horzcat(*slope) if isinstance(slope, tuple) else slope)).all()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("def f(a, b):\n    return np.zeros(3)[int(a)]", r"`f` .* `a` depends on state or inputs, .*\(line 2 "),
        ("def f(a, b):\n    while a > 0.0:\n        a -= 1.0\n    return a", r"`a > 0.0` depends on .*\(line 2 "),
        ("def f(a, b):\n    if a > 0.0:\n        return a\n    return b", r"a test on symbols decides on"),
        ("def f(a, b):\n    if a > 0.0:\n        c = a\n    return c", r"`c` is not defined, or not on every path"),
        ("def f(a, b):\n    x = np.zeros(2)\n    if a > 0.0:\n        x = x[1:]\n    return a", r"which array a name"),
        ("def f(a, b):\n    return np.empty(1)[0] + a", r"`f` cannot become .*\(line 2 "),
        ("def f(a, b):\n    return np.isfinite(a)", r"`a` depends on state or inputs"),
        ("def f(a, b):\n    return np.linalg.norm(a)", r"there is no rule|`np.linalg`|not known"),
        ("def f(a, b):\n    return [a, b]", r"there is no rule for List"),
        ("def f(a, b):\n    return a % b", r"the operator Mod is not one for symbols"),
        ("def f(a, b):\n    return g(a)\n\n\ndef g(a):\n    return a.tolist()", r"`g` .* `tolist` is not known"),
    ],
)  # fmt: skip
def test_what_is_not_known_is_an_error_with_its_line(text: str, reason: str) -> None:
    with pytest.raises(SettingsError, match=reason):
        walked(text)


def test_known_arrays_are_not_written_to() -> None:
    fixed = np.zeros(3)
    fixed.flags.writeable = False
    with pytest.raises(SettingsError, match="read-only"):
        Walk(Text("def f(x):\n    x[0] = 1.0")).call("f", [fixed])
    assert as_objects(fixed).flags.writeable
