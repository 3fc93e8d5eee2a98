"""Scores that are there: what a test expects to be a number and no None."""

from __future__ import annotations

from collections.abc import Sequence


def number(value: float | None) -> float:
    assert value is not None
    return value


def span(interval: Sequence[float] | None) -> tuple[float, float]:
    assert interval is not None
    return interval[0], interval[1]
