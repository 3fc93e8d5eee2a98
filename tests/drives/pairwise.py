"""Covering arrays: rows in which every pair of values of two factors stands at least once."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

Row = dict[str, Any]


def pairs_of(row: Mapping[str, Any]) -> set[tuple[tuple[str, Any], tuple[str, Any]]]:
    return set(itertools.combinations(sorted(row.items(), key=lambda item: item[0]), 2))


def all_pairs(factors: Mapping[str, Sequence[Any]]) -> set[tuple[tuple[str, Any], tuple[str, Any]]]:
    """Every pair of values of two factors."""
    names = sorted(factors)
    return {
        ((a, x), (b, y))
        for a, b in itertools.combinations(names, 2)
        for x, y in itertools.product(factors[a], factors[b])
    }


def covering(factors: Mapping[str, Sequence[Any]]) -> list[Row]:
    """Return rows that cover all pairs, each the best of what can follow: begun by a pair that is not covered yet."""
    left, rows = all_pairs(factors), []
    while left:
        row: Row = dict(min(left, key=repr))
        for name in sorted(factors, key=lambda name: -len(factors[name])):
            if name not in row:
                row[name] = max(factors[name], key=lambda value: len(pairs_of({**row, name: value}) & left))
        left -= pairs_of(row)
        rows.append(row)
    return rows
