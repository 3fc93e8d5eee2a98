"""A layout in the making: which columns were taken for what, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from softneck.core import Matrix, Vector

from ..recording._channels import MOTOR_POSITIONS, OUTPUTS, SET_POINTS, known_channels
from ._clocks import pitch_roll
from ._column_shapes import shortened
from ._column_titles import COUNTS_ROWS, Title, is_german, plain, read_title
from ._layout import Column, Quaternion, Term
from ._table_format import SniffResult


@dataclass(frozen=True, slots=True)
class Pick:
    """Columns taken for one channel.

    Attributes:
        terms: whose sum it is.
        why: it was taken.
        unit: where the title names one.
        sign: 1 or -1.
        confidence: probability that they are it, as far as names and data tell.
        unit_sure: whether the unit in the title has one meaning: `Grad` are degrees in German.
        integrate: whether they are rates whose sum it is.
    """

    terms: tuple[Term, ...]
    why: str
    unit: str | None = None
    sign: float = 1.0
    confidence: float = 0.97
    unit_sure: bool = True
    integrate: bool = False


@dataclass(slots=True)
class Draft:
    """The state of a guess; `picks` also holds time, run, inclination and orientation."""

    sniffed: SniffResult
    titles: dict[Column, Title] = field(default_factory=dict)
    moving: dict[Column, Vector] = field(default_factory=dict)
    picks: dict[str, Pick] = field(default_factory=dict)
    quaternion: Quaternion | None = None
    quaternion_why: str = ""
    quaternion_sure: float = 1.0
    passed_over: dict[Column, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.moving = shortened(self.sniffed.columns)
        units = self.sniffed.units
        self.titles = {
            name: read_title(f"{name} [{units[name]}]" if name in units else name)
            for name in self.sniffed.columns
            if isinstance(name, str)
        }
        for name, title in self.titles.items():
            if title.why == COUNTS_ROWS and name in self.moving and not _counts(self.moving[name]):
                self.titles[name] = replace(title, role="unknown", why="it has no name")

    def pick(self, channel: str, column: Column, why: str, *, sign: float = 1.0, confidence: float = 0.97) -> None:
        """Take one column for a channel."""
        title = self.titles.get(column)
        sure = "grad" not in plain(str(column)).replace("grados", "") or any(map(is_german, map(str, self.titles)))
        unit = title.unit if title else None
        self.picks[channel] = Pick((Term(column),), why, unit, sign, confidence, sure)

    def used(self) -> set[Column]:
        """Return all columns that were taken."""
        return {term.column for pick in self.picks.values() for term in pick.terms}

    def free(self) -> list[Column]:
        """Return columns that move, were not taken, and whose names do not say that they are something else."""
        used = self.used()
        said = {name for name, title in self.titles.items() if title.role not in ("unknown", "position", "set-point")}
        return [name for name in self.moving if name not in used and name not in said and name not in self.passed_over]

    def order(self) -> None:
        """Put the picks in the order in which a recording has its columns."""
        order = ("time", "run", *known_channels(), "inclination", "orientation")
        self.picks = {name: self.picks[name] for name in order if name in self.picks}

    def platform(self) -> dict[str, Vector]:
        """Return the first rows of pitch and roll, from a tilt too, to a factor."""
        there = [name for name in OUTPUTS if name in self.picks]
        if there:
            return {name: self.values(name) for name in there}
        if not self.has(("inclination", "orientation")):
            return {}
        turn = np.abs(self.values("orientation")).max(initial=0.0)
        # A tilt is small or in degrees; which of both does not touch a correlation.
        to_rad = np.pi / 180.0 if turn > 2.1 * np.pi else 1.0
        pitch, roll = pitch_roll(to_rad * self.values("inclination"), to_rad * self.values("orientation"))
        return {"pitch": pitch, "roll": roll}

    def has(self, channels: Sequence[str]) -> bool:
        """Return whether all `channels` were found."""
        return all(name in self.picks for name in channels)

    def values(self, channel: str) -> Vector:
        """Return the first rows of a channel as logged, without its unit."""
        pick = self.picks[channel]
        still = np.zeros(next(iter(self.moving.values())).size if self.moving else 0)
        return pick.sign * sum((t.factor * self.moving.get(t.column, still) for t in pick.terms), still)

    def motors(self) -> Matrix | None:
        """Return the first rows of the positions, or else of the set-points, (time, 3) as logged."""
        for names in (MOTOR_POSITIONS, SET_POINTS):
            if self.has(names):
                return np.column_stack([self.values(name) for name in names])
        return None

    def runs(self) -> np.ndarray:
        """Return the numbers of the runs of the first rows, by restarts of time."""
        rows = next(iter(self.moving.values())).size if self.moving else 0
        run = np.zeros(rows, dtype=np.int64)
        if "time" in self.picks and rows:
            run[1:] = np.cumsum(np.diff(self.values("time")) < 0)
        return run


def _counts(values: Vector) -> bool:
    """Return whether a column without a name is an index that a table was written with."""
    return bool((np.diff(values) == 1.0).all())


def say(column: Column) -> str:
    """Return a column as the lines of a guess name it."""
    return f"column {column!r}"
