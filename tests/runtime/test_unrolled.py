"""Runtime texts for so many motors and outputs: what runs over them is written out, all else is left as it is."""

from __future__ import annotations

import ast

import pytest

from softneck.runtime._unrolled import unroll

SIZES = {"motors": 2, "outputs": 1}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("P = 3 + 2 * MOTORS", "P = 7"),
        ("a = tuple(f(x[j], 2 * MOTORS + j) for j in range(MOTORS))", "a = (f(x[0], 4), f(x[1], 5))"),
        ("a = (b, *(x[1 + j] for j in range(MOTORS)), c)", "a = (b, x[1], x[2], c)"),
        ("for j in range(MOTORS):\n    s += x[j]\n    y[j] = s", "s += x[0]\ny[0] = s\ns += x[1]\ny[1] = s"),
        ("for j in range(n, MOTORS):\n    s += x[j]", "for j in range(n, 2):\n    s += x[j]"),
        ("if OUTPUTS > 1:\n    s = 1\nelse:\n    s = 2", "s = 2"),
        ("s = a if OUTPUTS > 1 else b", "s = b"),
        ("s = a if n > 1 else MOTORS", "s = a if n > 1 else 2"),
        ("for j in range(3):\n    s += 1 + 2", "for j in range(3):\n    s += 1 + 2"),
        ("MOTORS = 3", "MOTORS = 3"),
    ],
)
def test_motors_become_a_number_and_loops_over_them_text(text: str, expected: str) -> None:
    (function,) = ast.parse("def f():\n" + "".join(f"    {line}\n" for line in text.splitlines())).body
    statement = ast.parse(text).body[0]
    found = unroll(statement if text.startswith(("P", "MOTORS")) else function, SIZES)
    shown = ast.unparse(ast.fix_missing_locations(found))
    assert shown.removeprefix("def f():\n").replace("    ", "") == expected.replace("    ", "")
