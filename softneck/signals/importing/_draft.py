"""A layout under construction: the columns chosen for each channel, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from softneck.core import Matrix, Vector, to_si

from ..recording._channels import MOTOR_POSITIONS, OUTPUTS, SET_POINTS, known_channels
from ..recording._wraps import unwrap
from ._clocks import pitch_roll
from ._column_titles import COUNTS_ROWS, Title, ambiguity
from ._layout import Column, Quaternion, Term
from ._table_format import SniffResult

#: Below this confidence a decision is asked about, or marked.
SURE = 0.9
# Enough rows for a decision, whatever the length of the log.
_MAX_ROWS = 20_000
# Roles whose jumps mean something else.
_NEVER_WRAPPED = ("time", "run", "set-point", "ignored", "orientation")


def take_moving_rows(columns: Mapping[Column, Vector]) -> dict[Column, Vector]:
    """Return the first rows of the columns that move; missed samples become the column's mean."""
    found: dict[Column, Vector] = {}
    for name, values in columns.items():
        head = values[:_MAX_ROWS]
        present = np.isfinite(head)
        # Sums of fourth powers of numbers beyond 1e60 would overflow.
        if present.any() and np.ptp(head[present]) > 0 and np.abs(head[present]).max() < 1e60:
            found[name] = np.where(present, head, head[present].mean())
    return found


@dataclass(frozen=True, slots=True)
class Doubt:
    """One uncertain decision.

    `about`: subject, in words. `taken`: the choice made. `confidence`: probability that it is right, 0 to 1. `choices`:
    alternatives for `settle_doubt`; without any, the columns have to be edited in the layout.
    """

    about: str
    channels: tuple[str, ...]
    taken: str
    confidence: float
    why: str
    choices: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return one line: the choice, its confidence and its reason."""
        return f"{self.about}: {self.taken} ({percent(self.confidence)} sure): {self.why}"

    def as_dict(self) -> dict[str, object]:
        """Return the JSON values."""
        return {**asdict(self), "confidence": round(self.confidence, 3)}


def percent(confidence: float) -> str:
    """Return a probability in %, without decimals."""
    return f"{100.0 * confidence:.0f} %"


@dataclass(frozen=True, slots=True)
class Pick:
    """The columns chosen for one channel.

    `terms`: of a weighted sum of columns. `unit`: named by the title, or None. `confidence`: probability that the
    columns are right, by names and data. `ambiguous`: what the title's unit leaves open, or "". `integrate`: whether
    the columns are rates to integrate.
    """

    terms: tuple[Term, ...]
    why: str
    unit: str | None = None
    sign: float = 1.0
    confidence: float = 0.97
    ambiguous: str = ""
    integrate: bool = False


@dataclass(slots=True)
class Draft:
    """The state of a guess; `picks` also holds time, run, inclination and orientation. `neck`: of the neck's log."""

    sniffed: SniffResult
    neck: bool = True
    titles: dict[Column, Title] = field(default_factory=dict)
    moving: dict[Column, Vector] = field(default_factory=dict)
    picks: dict[str, Pick] = field(default_factory=dict)
    quaternion: Quaternion | None = None
    quaternion_why: str = ""
    quaternion_sure: float = 1.0
    passed_over: dict[Column, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.titles = {name: self.sniffed.title(name) for name in self.sniffed.columns if isinstance(name, str)}
        self.moving = take_moving_rows({name: self._continuous(name) for name in self.sniffed.columns})
        for name, title in self.titles.items():
            if title.why == COUNTS_ROWS and name in self.moving and not (np.diff(self.moving[name]) == 1.0).all():
                self.titles[name] = replace(title, role="unknown", why="it has no name")

    def _continuous(self, name: Column) -> Vector:
        """Return the first rows of a column, an angle without its jumps by a turn."""
        values, title = self.sniffed.columns[name][:_MAX_ROWS], self.titles.get(name)
        if title is not None and title.role in _NEVER_WRAPPED:
            return values
        angle = to_si(title.unit)[0] if title is not None and title.unit and title.quantity == "rad" else None
        for turn in (360.0, 2.0 * np.pi) if angle is None else (2.0 * np.pi / angle,):
            unwrapped, jumps = unwrap(values, np.zeros(values.size), turn)
            if jumps:
                return unwrapped
        return values

    def pick(self, channel: str, column: Column, why: str, *, sign: float = 1.0, confidence: float = 0.97) -> None:
        """Take one column for a channel."""
        title, unit, ambiguous = self.titles.get(column), None, ""
        if title is not None and title.quantity in (("s",) if channel == "time" else ("rad", "rad/s")):
            unit, ambiguous = title.unit, ambiguity(title, self.titles)
        self.picks[channel] = Pick((Term(column),), why, unit, sign, confidence, ambiguous)

    def used_columns(self) -> set[Column]:
        """Return all columns in use."""
        return {term.column for pick in self.picks.values() for term in pick.terms}

    def free(self) -> list[Column]:
        """Return moving columns that are not in use and may be motors or outputs by their names."""
        used = self.used_columns()
        named = {name for name, title in self.titles.items() if title.role not in ("unknown", "position", "set-point")}
        return [name for name in self.moving if name not in used and name not in named and name not in self.passed_over]

    def order(self) -> None:
        """Sort the picks into the column order of a recording."""
        order = ("time", "run", *known_channels(), "inclination", "orientation")
        self.picks = {name: self.picks[name] for name in order if name in self.picks}

    def platform(self) -> dict[str, Vector]:
        """Return the first rows of pitch and roll, up to a factor; a tilt is converted."""
        there = [name for name in OUTPUTS if name in self.picks]
        if there:
            return {name: self.values(name) for name in there}
        if not self.has(("inclination", "orientation")):
            return {}
        turn = np.abs(self.values("orientation")).max(initial=0.0)
        # Degrees or radians of a small tilt do not change a correlation.
        to_rad = np.pi / 180.0 if turn > 2.1 * np.pi else 1.0
        pitch, roll = pitch_roll(to_rad * self.values("inclination"), to_rad * self.values("orientation"))
        return {"pitch": pitch, "roll": roll}

    def has(self, channels: Sequence[str]) -> bool:
        """Return whether all `channels` have a pick."""
        return all(name in self.picks for name in channels)

    def values(self, channel: str) -> Vector:
        """Return the first rows of a channel as logged, in the unit of the log."""
        pick = self.picks[channel]
        still = np.zeros(next(iter(self.moving.values())).size if self.moving else 0)
        return pick.sign * sum((t.factor * self.moving.get(t.column, still) for t in pick.terms), still)

    def motors(self) -> Matrix | None:
        """Return the first rows of the positions, else of the set-points, (time, 3) as logged."""
        for names in (MOTOR_POSITIONS, SET_POINTS):
            if self.has(names):
                return np.column_stack([self.values(name) for name in names])
        return None

    def runs(self) -> np.ndarray:
        """Return run numbers of the first rows, from restarts of time."""
        rows = next(iter(self.moving.values())).size if self.moving else 0
        run = np.zeros(rows, dtype=np.int64)
        if "time" in self.picks and rows:
            run[1:] = np.cumsum(np.diff(self.values("time")) < 0)
        return run


def column_label(column: Column) -> str:
    """Return a column as the lines of a guess name it."""
    return f"column {column!r}"
