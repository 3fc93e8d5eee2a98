"""What a guess is not sure of: asked in a terminal, or marked in the layout file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from softneck.core import SettingsError

from ..recording._channels import MOTOR_POSITIONS, MOTOR_VELOCITIES, OUTPUTS, SET_POINTS
from ._draft import Draft, say
from ._guess_units import Unit
from ._layout import ONE_AXIS, Layout

#: Below it a guess is asked about, or marked.
SURE = 0.9
_TILT = (*OUTPUTS, "inclination", "orientation", "pitch_reference", "roll_reference")
_GROUPS = {"motor set-points": SET_POINTS, "motor positions": MOTOR_POSITIONS, "motor velocities": MOTOR_VELOCITIES}
_AS_LOGGED = "as logged"
# However surely the motors say so: a log that says otherwise by its titles is worth a question.
_MOST_SURE = 0.89


@dataclass(frozen=True, slots=True)
class Doubt:
    """One guess that is not sure.

    Attributes:
        about: what it is about, for people.
        channels: of the recording.
        taken: what was taken.
        confidence: probability that it is right, 0 to 1.
        why: it was taken.
        choices: what else `settled` takes; without any, the columns have to be edited in the layout.
    """

    about: str
    channels: tuple[str, ...]
    taken: str
    confidence: float
    why: str
    choices: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line: what was taken, how surely and why."""
        return f"{self.about}: {self.taken} ({percent(self.confidence)} sure): {self.why}"

    def as_dict(self) -> dict[str, object]:
        """Return it for JSON."""
        return {**asdict(self), "confidence": round(self.confidence, 3)}


def percent(confidence: float) -> str:
    """Return a probability for people; none is 100 % unless it is certain."""
    return f"{100.0 * confidence:.0f} %"


def doubts_of(draft: Draft, found: dict[str, Unit]) -> list[Doubt]:
    """Return what is less than 90 % sure of columns and units, the least sure first."""
    doubts = [*_columns(draft), *_units(draft, found)]
    if draft.quaternion is not None and draft.quaternion_sure < SURE:
        q = draft.quaternion
        taken = f"pitch about {q.pitch}, roll about {q.roll}"
        doubts.append(Doubt("axes of the sensor", OUTPUTS, taken, draft.quaternion_sure, draft.quaternion_why))
    return sorted(doubts, key=lambda doubt: doubt.confidence)


def _columns(draft: Draft) -> list[Doubt]:
    doubts: list[Doubt] = []
    taken: set[str] = set()
    for about, channels in [*_GROUPS.items(), *((name, (name,)) for name in draft.picks)]:
        names = tuple(name for name in channels if name in draft.picks and name not in taken)
        taken |= set(names)
        sure = min((draft.picks[name].confidence for name in names), default=1.0)
        if sure < SURE:
            columns = dict.fromkeys(term.column for name in names for term in draft.picks[name].terms)
            doubts.append(Doubt(about, names, ", ".join(map(say, columns)), sure, draft.picks[names[0]].why))
    return doubts


def _units(draft: Draft, found: dict[str, Unit]) -> list[Doubt]:
    doubts: list[Doubt] = []
    groups = {**_GROUPS, "angles of the platform": _TILT, "time": ("time",)}
    motors = [found[name].name for name in (SET_POINTS[0], MOTOR_POSITIONS[0]) if name in draft.picks and name in found]
    if len(motors) == 2 and motors[0] == motors[1]:
        del groups["motor set-points"], groups["motor positions"]
        groups = {"motor set-points and positions": (*SET_POINTS, *MOTOR_POSITIONS), **groups}
    for about, channels in groups.items():
        names = tuple(name for name in channels if name in draft.picks and name in found)
        if not names or min(found[name].confidence for name in names) >= SURE:
            continue
        unit = min((found[name] for name in names), key=lambda one: one.confidence)
        rate = "/s" if unit.name.endswith("/s") else ""
        choices = ("s", "ms") if about == "time" else (f"rad{rate}", f"deg{rate}")
        other = tuple(choice for choice in choices if choice != unit.name)
        doubts.append(Doubt(f"unit of {about}", names, unit.name, unit.confidence, unit.why, other))
    return doubts


def sign_doubt(axis: str, name: str, r: float) -> Doubt:
    """Return the doubt in the sign of an angle that was turned round as it falls where the motors' `name` rises."""
    order = "; or motors 2 and 3 are swapped" if axis == "roll" else ""
    why = f"as logged {axis} falls as {name} rises (correlation {r:.2f}), and recordings have both rise{order}"
    return Doubt(f"sign of {axis}", (axis,), "turned round", min(_MOST_SURE, 0.5 - 0.5 * r), why, (_AS_LOGGED,))


def duplicates_doubt(rows: int, first: int) -> Doubt:
    """Return the doubt in rows of one time stamp."""
    why = f"time stands still at {rows} row(s), first at row {first}"
    return Doubt("rows of one time stamp", ("time",), "the first", 0.8, why, ("last",))


def jitter_doubt(shortest: float, longest: float, usual: float) -> Doubt:
    """Return the doubt in a clock whose steps [s] are of all lengths: rows may be even and their stamps late."""
    why = (
        f"steps are {1e3 * shortest:.3g} to {1e3 * longest:.3g} ms, of all lengths between: the clock jitters and no "
        f"gap is seen; if rows were taken evenly write `sample_time_s = {usual:.4g}` into [time]"
    )
    return Doubt("clock", ("time",), "rows as they are stamped, resampled", 0.8, why)


def one_axis_doubt(axis: str) -> Doubt:
    """Return the doubt in a log of one angle: a neck has two, and the other may have got lost on its way."""
    other = "roll" if axis == "pitch" else "pitch"
    why = (
        f"no column is {other} or answers the motors like it, so the robot has one output; log {other} too if it tilts"
    )
    return Doubt(ONE_AXIS, (axis,), f"{axis} only", 0.8, why)


def settled(layout: Layout, doubt: Doubt, choice: str) -> Layout:
    """Return the layout where a doubt was settled by one of its choices."""
    if choice not in doubt.choices:
        raise SettingsError(f"{doubt.about}: `{choice}` is none of {', '.join(doubt.choices) or 'no choices'}.")
    if doubt.about == "rows of one time stamp":
        return replace(layout, duplicates=choice)
    if doubt.about.startswith("sign of"):
        return _changed(layout, doubt.channels, sign=-1.0)
    return _changed(layout, doubt.channels, unit=choice)


def _changed(layout: Layout, channels: Sequence[str], *, unit: str | None = None, sign: float = 1.0) -> Layout:
    """Return the layout with another unit, or turned round, in some channels, the tilt or the time."""
    sources = {name: source for name, source in layout.channels.items() if name in channels}
    found = {n: replace(s, unit=unit or s.unit, sign=sign * s.sign) for n, s in sources.items()}
    rest = {
        name: replace(source, unit=unit, terms=source.terms if name != "time" else _bare(source.terms))
        for name in ("inclination", "orientation", "time")
        if unit is not None and name in channels and (source := getattr(layout, name)) is not None
    }
    return replace(layout, channels={**layout.channels, **found}, **rest)


def _bare(terms: tuple) -> tuple:
    """Return the terms of a time without the factor that belonged to another unit."""
    return tuple(replace(term, factor=1.0) for term in terms) if len(terms) == 1 else terms
