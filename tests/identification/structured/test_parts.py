"""Which parts of the grey box are chosen, over searches that only note which parts they were asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import pytest

from softneck.core import silent
from softneck.identification.structured import _parts
from softneck.identification.structured._output_error import SearchProgress


@dataclass(frozen=True)
class Problem:
    """A problem with some parts; its start has one number for each."""

    parts: tuple[str, ...]
    logged: bool
    has_two_outputs: bool = True
    has_neck_tendons: bool = True

    def as_sure_as(self, _x: Sequence[str], _delay: int) -> Problem:
        return self

    def with_parts(self, *parts: str) -> Problem:
        return replace(self, parts=(*self.parts, *parts))

    def search(self, x: Sequence[str], delay: int, _evaluations: int, _tell: Any) -> Any:
        assert tuple(x) == self.parts
        return SimpleNamespace(problem=self, x=x, delay=delay, cost=1.0)


@dataclass(frozen=True)
class Trial:
    """A trial whose fit is better by what each of its parts gains."""

    found: Any
    gains: dict[str, float]

    def fit(self) -> float:
        return 50.0 + sum(self.gains.get(part, 0.0) for part in self.found.problem.parts)

    def without(self, part: str) -> Trial:
        parts = tuple(one for one in self.found.problem.parts if one != part)
        return replace(self, found=_found(replace(self.found.problem, parts=parts)))


def _found(problem: Problem, cost: float = 1.0) -> Any:
    return SimpleNamespace(problem=problem, x=problem.parts, delay=0, cost=cost)


@pytest.mark.parametrize("gains", [{}, {"creep": 20.0}, {"creep": 20.0, "speed": 20.0}], ids=["none", "creep", "both"])
@pytest.mark.parametrize(("logged", "cost"), [(True, 0.5), (True, 0.95), (False, 0.5)], ids=["shows", "not", "unknown"])
def test_speed_that_logged_motors_show_is_kept_whatever_the_rows_left_out_confirm(
    gains: dict[str, float], logged: bool, cost: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []

    def extend(found: Any, parts: Sequence[str], _evaluations: int, _tell: Any) -> Any:
        asked.append(tuple(parts))
        return _found(found.problem.with_parts(*parts), cost if tuple(parts) == ("speed",) else 1.0)

    monkeypatch.setattr(_parts, "extend", extend)
    monkeypatch.setattr(_parts, "folds", lambda *_, **__: [None])
    monkeypatch.setattr(_parts, "other_motion", lambda _: False)
    monkeypatch.setattr(_parts, "_Trial", Trial)
    monkeypatch.setattr(_parts, "_trial", lambda found, *_: Trial(found, gains))
    scaled: Any = SimpleNamespace(data=None)
    chosen, said = _parts.choose_parts(_found(Problem((), logged)), scaled, 4, SearchProgress(silent, 4))
    shows = logged and cost < 0.9
    # Where motors are logged and do not show it, it is no candidate; where they are not, rows left out decide alone.
    gained = {part for part in gains if part != "speed" or shows or not logged}
    assert set(chosen.problem.parts) == gained | ({"speed"} if shows else set())
    assert len(chosen.problem.parts) == len(set(chosen.problem.parts))
    assert said.keys() == ({"parts"} if gained else set())
    # Only the first question, over all rows, is of a speed that does not show.
    assert logged <= (asked[0] == ("speed",))
    assert shows or not logged or not any("speed" in parts for parts in asked[1:])
