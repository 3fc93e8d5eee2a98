"""Which parts of the grey box are chosen, over searches that only note which parts they were asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import silent
from softneck.identification import GreyBox
from softneck.identification.structured import _parts
from softneck.identification.structured._greybox import as_found
from softneck.identification.structured._output_error import Found, SearchProgress
from softneck.identification.structured._parameters import NO_EFFECT, PARTS


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

    def coarse(self) -> Problem:
        return self

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

    def with_only(self, parts: Sequence[str], _evaluations: int, _tell: Any) -> Trial:
        return replace(self, found=_found(replace(self.found.problem, parts=tuple(parts))))


def _found(problem: Any, cost: float = 1.0) -> Found:
    x: Any = problem.parts
    return Found(problem, x, 0, cost)


@pytest.mark.parametrize(("spatial", "able"), [(True, 8), (False, 6)], ids=["two outputs", "a plane"])
@pytest.mark.parametrize("cost", [0.85, 0.95], ids=["speed shows", "it does not"])
@pytest.mark.parametrize(
    ("gains", "kept"),
    [
        ({"creep": 0.4}, ()),
        ({"creep": 0.6}, ("all",)),
        ({"creep": -20.0}, ()),
        ({"creep": 10.0, "stop": -20.0}, ("creep",)),
        ({"creep": 4.0, "stop": -20.0}, ()),
        # Alone it leaves 10 of 30 points, or 10 of 15, which are no less than two thirds.
        ({"arc": 40.0, "stop": -20.0}, ("arc",)),
        ({"arc": 40.0, "stop": -5.0}, ("all",)),
        (None, ()),
    ],
)
def test_parts_are_kept_where_what_was_left_out_is_fitted_better(
    gains: dict[str, float] | None, kept: tuple[str, ...], cost: float, spatial: bool, able: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """All must gain half a point, which seeds of the noise move fits by, chosen ones a tenth of what is missing.

    None: too little was recorded to leave anything out.
    """

    def extend(found: Any, parts: Sequence[str], _evaluations: int, _tell: Any) -> Any:
        return _found(found.problem.with_parts(*parts), cost if tuple(parts) == ("speed",) else 1.0)

    monkeypatch.setattr(_parts, "extend", extend)
    monkeypatch.setattr(_parts, "folds", lambda *_, **__: [] if gains is None else [None])
    monkeypatch.setattr(_parts, "other_motion", lambda _: False)
    monkeypatch.setattr(_parts, "_Trial", Trial)
    monkeypatch.setattr(_parts, "_trial", lambda found, *_: Trial(found, gains or {}))
    monkeypatch.setattr(_parts, "_found_again", lambda *_: ("arc",))
    scaled: Any = SimpleNamespace(data=None)
    rigid = _found(Problem((), True, has_two_outputs=spatial))
    chosen, told, said = _parts.choose_parts(rigid, scaled, 4, SearchProgress(silent, 4))
    if kept == ("all",):
        assert len(chosen.problem.parts) == able
    else:  # what logged motors show needs no rows left out
        assert chosen.problem.parts == (kept or (("speed",) if cost < 0.9 else ()))
    # Of parts that motions left out confirm only what each training finds again is told.
    assert told == (("arc",) if kept else tuple(NO_EFFECT))
    fits = {"rigid": 50.0, "all": 50.0 + sum((gains or {}).values())}
    fits |= {part: 50.0 + (gains or {}).get(part, 0.0) for part in kept if part != "all"}
    # That which shows is tried alone where there are others.
    fits |= {"arc": 50.0 + (gains or {}).get("arc", 0.0)} if kept != ("creep",) else {}
    assert said == ({"parts": fits} if kept else {})


@dataclass(frozen=True)
class NumberTrial:
    """A trial that loses a point without any of the needed parts."""

    found: Found
    needed: tuple[str, ...]
    lost: float = 0.0

    def without(self, part: str) -> NumberTrial:
        return replace(self, lost=1.0 if part in self.needed else 0.0)

    def fit(self) -> float:
        return 90.0 - self.lost


@pytest.mark.parametrize(
    ("arcs", "needed", "told"),
    [
        ((1.2, 0.9), True, True),
        ((1.2, 0.4), True, False),  # less than half
        ((1.2, -0.9), True, False),
        ((1.2, 0.9), False, False),  # what was left out is fitted as well without
    ],
)
def test_numbers_are_told_of_that_each_training_finds_again_and_needs(
    arcs: tuple[float, float], needed: bool, told: bool
) -> None:
    def found(arc: float, arm: float) -> Found:
        numbers = (*PARTS["arc"], *PARTS["tendons"][2:])
        problem: Any = SimpleNamespace(numbers=numbers, parts=("arc",))
        return Found(problem, np.array([arc, np.log(arm), 0.0]), 2, 1.0)

    trials: Any = [NumberTrial(found(arc, 1.1), ("arc",) * needed) for arc in arcs]
    assert _parts._found_again(found(1.0, 1.1), trials) == (("arc",) if told else ())


def test_what_is_told_differs_from_no_effect_with_confidence() -> None:
    """1 rad/rad^2 takes 0.25 rad of motor off at 0.5 rad; 0.6 of 1 + 0.6 + 0.4 creeps away, 0.4 of 1.8, 0.8 of 2.2."""
    values = {
        "asymmetry": (0.0, -0.1, 0.1), "arc": (1.0, 0.8, 1.2), "home_pitch": (0.01, -0.01, 0.03),
        "home_roll": (-0.01, -0.03, 0.01), "creep": (0.6, 0.4, 0.8), "creep_rate": (0.5, 0.4, 0.6),
        "slow_creep": (0.4, 0.0, 0.8), "slow_creep_rate": (0.1, 0.0, 0.2), "top_speed": (10.0, 8.0, 12.0),
    }  # fmt: skip
    table: list[dict[str, Any]] = [
        dict(zip(("name", "value", "low", "high"), (name, *row), strict=True)) for name, row in values.items()
    ]
    # A neck of half the pace: one of its equations' seconds is two.
    shown = _parts.differing(table, tuple(NO_EFFECT))
    assert _parts.describe_parts(0.5, table, shown, 2.0).split("; ") == [
        "30 (22 to 36) % of the stiffness creeps away with a time constant of 4 s",
        "a bend of 29 deg takes 0.25 (0.2 to 0.3) rad of motor off each tendon",
        "drives turn at up to 5 (4 to 6) rad/s",
    ]
    assert _parts.differing(table, ("top_speed", "home_roll")) == {"top_speed"}


@pytest.mark.parametrize(
    ("confirmed", "body"),
    [(["arc", "speed"], "arc+speed"), ([], "rigid"), (None, "creep")],
    ids=["some", "none", "old"],
)
def test_other_rows_are_trained_with_what_was_confirmed(confirmed: list[str] | None, body: str) -> None:
    """A file from before has no list of them: its parts were chosen one by one."""
    said = {} if confirmed is None else {"confirmed": confirmed}
    model: Any = SimpleNamespace(findings={"sensor_delay": 3, **said}, settings={"body": "creep"})
    assert as_found(GreyBox(evaluations=5), model) == GreyBox(evaluations=5, sensor_delay=3, body=body)
