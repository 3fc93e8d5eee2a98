"""Names of arrays and state: places in the text, shapes in the file, and no name that nobody declared."""

from __future__ import annotations

import ast
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import KINDS, FileFormatError, SettingsError
from softneck.runtime import load_runtime
from softneck.runtime._bundle import layout_of
from softneck.runtime._layout import Arrays, StateVector, array, cells, evaluate, rest, value
from softneck.runtime._names import lower

RUNTIMES = sorted({kind.runtime for kind in KINDS.values() if kind.runtime} | {"softneck.plant._neck_runtime"})


class Base(Arrays):
    history = array("1", "")
    H = value("history", 0)


class Matrices(Base):
    A = array("n, n", "")
    c = array("q", "")
    B = array("n, 2 * q", "")


class Memory(StateVector):
    count = cells("", "")
    y = cells("H, 2", "")
    x = cells("n", "")
    flags = cells("2 * (n + 1), q", "")
    tail = rest("")


def run(body: str, H: int = 3, n: int = 2, q: int = 2, x: np.ndarray | None = None) -> Any:
    """Run the lowered text of a function of `p: Matrices` and `x: Memory`, and return what it returns."""
    lines = "\n    ".join(body.splitlines())
    function = ast.parse(f'def f(p: Matrices, x: Memory, i: int = 0):\n    """Words."""\n    {lines}').body[0]
    assert isinstance(function, ast.FunctionDef)
    names = {"Matrices": Matrices, "Memory": Memory}
    text = ast.unparse(lower(function, names.get, "here", {}))
    assert "Words" not in text
    space: dict[str, Any] = {}
    exec(text, space)
    p = (np.array([float(H)]), np.arange(n * n).reshape(n, n), np.arange(10.0, 10.0 + q), np.zeros((n, 2 * q)))
    return space["f"](p, np.arange(100.0) if x is None else x)


@given(H=st.integers(1, 6), n=st.integers(1, 5), q=st.integers(1, 4), data=st.data())
def test_a_name_is_the_place_that_the_parts_before_it_leave(H: int, n: int, q: int, data: st.DataObject) -> None:
    parts = {"count": (1,), "y": (H, 2), "x": (n,), "flags": (2 * (n + 1), q)}
    starts = dict(zip(parts, itertools.accumulate([0, *(int(np.prod(s)) for s in parts.values())]), strict=False))
    name = data.draw(st.sampled_from(["y", "x", "flags"]))
    shape, start = parts[name], starts[name]
    index = tuple(data.draw(st.integers(0, length - 1)) for length in shape)
    expected = start + int(np.ravel_multi_index(index, shape))
    assert run(f"return x.{name}[{', '.join(map(str, index))}]", H, n, q) == expected
    whole = np.arange(start, start + np.prod(shape), dtype=float)
    np.testing.assert_array_equal(run(f"return x.{name}", H, n, q), whole)
    np.testing.assert_array_equal(run(f"return x.{name}[1:]", H, n, q), whole.reshape(shape)[1:].ravel())
    np.testing.assert_array_equal(run("return x.tail", H, n, q)[0], starts["flags"] + np.prod(parts["flags"]))
    arrays = Matrices((np.array([float(H)]), np.zeros((n, n)), np.zeros(q), np.zeros((n, 2 * q))))
    assert Memory.parts(arrays)[name] == slice(start, start + len(whole))
    assert run("return Memory.size(p)", H, n, q) == Memory.size(arrays) == starts["flags"] + np.prod(parts["flags"])


def test_numbers_and_rows_are_written_where_they_are_read() -> None:
    x = np.zeros(40)
    run("x.count = 4.0\nx.count += 1.0\nx.y[1, 1] = 7.0\nx.y[2] = 8.0\nx.x[:] = 9.0", x=x)
    assert x.tolist() == [5.0, 0.0, 0.0, 0.0, 7.0, 8.0, 8.0, 9.0, 9.0, *[0.0] * 31]


def test_arrays_and_lengths_have_names() -> None:
    np.testing.assert_array_equal(run("return p.A"), [[0, 1], [2, 3]])
    assert run("return p.c[1] + p.A[1, 0]") == 13.0
    assert run("return p.H, p.n, p.q", H=5, n=3, q=4) == (5, 3, 4)
    # Read where the function begins: what the body does to the array later changes no place.
    assert run("p.history[0] = 1.0\nreturn p.H", H=4) == 4


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ("return p.W7", "declares neither an array nor a length `W7`"),
        ("return x.speed", "Memory declares no `speed`"),
        ("return x.y[0, :]", "no contiguous slice of the state"),
        ("return x.x[::2]", "a slice of the state cannot have a step"),
        ("return x.tail[:3]", r"only `\[begin:\]`"),
    ],
)
def test_what_has_no_place_is_refused_with_function_and_module(body: str, problem: str) -> None:
    with pytest.raises(SettingsError, match=f"here: `f`: .*{problem}"):
        run(body)


def test_a_part_whose_place_depends_on_arrays_needs_them() -> None:
    function = ast.parse("def f(x: Memory):\n    return x.x[0]").body[0]
    assert isinstance(function, ast.FunctionDef)
    with pytest.raises(SettingsError, match="needs the length `H` and has no arrays"):
        lower(function, {"Memory": Memory}.get, "here", {})


def test_shapes_that_do_not_fit_each_other_are_named() -> None:
    good = {"history": np.ones(1), "A": np.zeros((2, 2)), "c": np.zeros(3), "B": np.zeros((2, 6))}
    assert Matrices.lengths(good) == {"H": 1, "n": 2, "q": 3}
    for name, shape in (("A", (2, 3)), ("A", (2,)), ("history", (1, 1)), ("B", (2, 3)), ("c", (2,))):
        named = "B" if name == "c" else name  # whichever comes later does not fit the first
        with pytest.raises(FileFormatError, match=rf"`{named}` has shape .* is needed"):
            Matrices.lengths(good | {name: np.ones(shape)})


@given(a=st.integers(0, 99), b=st.integers(0, 99))
def test_lengths_are_evaluated_as_python_would(a: int, b: int) -> None:
    assert evaluate("3 * (a + 1) - b // 2", {"a": a, "b": b}) == 3 * (a + 1) - b // 2


@pytest.mark.parametrize("text", ["a ** 2", "a.b", "f(a)", "c", "1.5", "a if a else a"])
def test_a_length_is_whole_numbers_and_letters(text: str) -> None:
    with pytest.raises(SettingsError, match="may only use a"):
        evaluate(text, {"a": 1})


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_every_kind_says_what_each_array_and_part_is(runtime: str) -> None:
    for layout in (layout_of(runtime, Arrays), layout_of(runtime, StateVector)):
        assert layout.fields
        assert layout.__doc__
        named = [name for name, item in layout.fields.items() if item.meaning]
        # A matrix of the equation in the docstring, such as A or Br, says all by its letters.
        assert all(name in named or len(name) <= 2 for name in layout.fields)
    assert load_runtime(runtime.partition("(")[0], compiled=False) if "predictive._nmpc" not in runtime else True
