"""Digests of content: equal content is found again, any other is not, and what has no content is computed anew."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import compute_once, content_digest


@dataclass(frozen=True)
class Point:
    x: float
    names: tuple[str, ...]
    read_from: str = field(default="", metadata={"content": False})


@dataclass(frozen=True)
class Place:
    x: float
    names: tuple[str, ...]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (np.array([1.0, 2.0]), np.array([1.0, np.nextafter(2.0, 3.0)])), (np.zeros((2, 3)), np.zeros((3, 2))),
        (np.zeros(2), np.zeros(2, dtype=np.int64)), (0.0, -0.0), (1, True), (1, "1.0"), (None, "None"), ("a", b"a"),
        (["ab", "c"], ["a", "bc"]), ([["a"], "b"], [["a", "b"]]), ({"a": 1}, ["a", 1]),
        (Point(1.0, ()), Place(1.0, ())),
        (Point(1.0, ("a",)), Point(1.0, ("b",))), (2**60, 2**60 + 1), (Path("a"), "a"), ([], {}),
    ],
)  # fmt: skip
def test_other_content_has_another_digest(one: Any, other: Any) -> None:
    assert content_digest(one) != content_digest(other)
    assert content_digest({"key": [one]}) != content_digest({"key": [other]})


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (np.arange(6.0).reshape(2, 3).T, np.ascontiguousarray(np.arange(6.0).reshape(2, 3).T)), (3, 3.0),
        ((1, [2]), [1.0, (2.0,)]), (np.float64(0.1), 0.1), (np.nan, float("nan")), ({"a": (1,)}, {"a": [1]}),
    ],
)  # fmt: skip
def test_equal_content_has_one_digest_whatever_holds_it(one: Any, other: Any) -> None:
    assert content_digest(one) == content_digest(other) is not None


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(st.lists(_VALUES, max_size=3), st.lists(_VALUES, max_size=3))
def test_values_have_the_digest_of_their_writing(one: list[Any], other: list[Any]) -> None:
    def written(value: Any) -> str:
        if isinstance(value, list):
            return f"[{', '.join(map(written, value))}]"
        if isinstance(value, dict):
            return f"{{{', '.join(f'{key!r}: {written(item)}' for key, item in value.items())}}}"
        whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53
        return repr(float(value) if whole else value)

    assert (written(one) == written(other)) == (content_digest(*one) == content_digest(*other))


def test_a_function_has_no_content() -> None:
    for thing in (len, object(), np.array([None]), Point, {1, 2}):
        assert content_digest({"a": [1.0, thing]}) is None


def test_equal_content_is_computed_once_and_any_other_again() -> None:
    calls: list[Any] = []

    def run(*things: Any) -> list[Any]:
        def compute() -> list[Any]:
            calls.append(things)
            return list(calls)

        return compute_once(compute, *things)

    point = Point(0.5, ("once",))
    first = run(point, np.ones(3))
    assert run(replace(point, read_from="file"), np.ones(3)) is first
    assert run(replace(point, x=0.25), np.ones(3)) is not first
    assert len(calls) == 2
    assert run(point, len) is not run(point, len)

    def compute() -> str:
        return "of another function"

    assert compute_once(compute, point, np.ones(3)) == "of another function"
