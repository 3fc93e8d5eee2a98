"""A layout proposed from a log: `softneck import --guess`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from softneck.core import DataError

from ..recording._channels import MOTOR_POSITIONS, MOTORS, SET_POINTS
from ..recording._redefinition import redefine
from ._column_shapes import lagged
from ._draft import Draft, say
from ._guess_names import by_names
from ._guess_shapes import by_shapes
from ._guess_units import Unit, nominal_step, units
from ._layout import Column, Layout, Source, Term
from ._layout_text import layout_toml
from ._sample_time import SampleTime, estimate_sample_time
from ._table_format import sniff

_VELOCITIES = tuple(f"motor_velocity_{j}" for j in MOTORS)
_NO_CHANNELS = ("time", "run", "inclination", "orientation")
# Half a second at 20 ms: the platform answers within it.
_NECK_LAG = 25


@dataclass(frozen=True, slots=True)
class Guess:
    """A layout that was proposed for a log, with the reason for each line.

    Attributes:
        layout: as far as it goes.
        text: the same as TOML, with a remark on each line and what is still open at its end.
        lines: what was taken for what, and why; what was left out, and why; what is not sure.
        missing: what a recording needs and was not found, each with its candidates.
    """

    layout: Layout
    text: str
    lines: tuple[str, ...]
    missing: tuple[str, ...]


def guess_layout(path: str | Path) -> Guess:
    """Return a layout for a log (CSV, Parquet, MAT) of which nothing is known.

    Raises:
        FileFormatError: no such file, or no table.
        DataError: a table of fewer columns than a recording needs.
    """
    # Damaged logs hold infinities; sums of them are no news to the user.
    with np.errstate(all="ignore"):
        return _guess(Path(path))


def _guess(path: Path) -> Guess:
    draft = Draft(sniff(path))
    by_names(draft)
    by_shapes(draft)
    draft.order()
    found = units(draft)
    layout, clock_lines = _clocked(draft, found, _layout(draft, found))
    missing = _missing(draft, layout)
    remarks = {name: _why(draft, found, name) for name in draft.picks}
    remarks["file"] = "; ".join(line.removeprefix("file: ") for line in draft.sniffed.lines)
    remarks["sample_time"] = "; ".join(clock_lines)
    text = layout_toml(layout, remarks=remarks, open_ends=[f"MISSING {line}" for line in missing])
    lines = [*draft.sniffed.lines, *(_line(draft, found, name) for name in draft.picks), *clock_lines]
    lines += [*_checks(draft), *_left_out(draft)]
    return Guess(layout, f"# Proposed by `softneck import --guess` for {path.name!r}; edit it.\n\n{text}",
                 tuple(lines), missing)  # fmt: skip


def _layout(draft: Draft, found: dict[str, Unit]) -> Layout:
    def source(name: str) -> Source:
        pick, (unit, factor, _) = draft.picks[name], found[name]
        terms = tuple(Term(term.column, factor * term.factor) for term in pick.terms)
        return Source(terms, unit, pick.sign)

    tilt = "inclination" in draft.picks and "orientation" in draft.picks
    asked = [term.column for name in SET_POINTS if name in draft.picks for term in draft.picks[name].terms]
    return replace(
        draft.sniffed.form,
        # A set-point is never missed, as a measurement may be: where it is not said it holds.
        merge=draft.sniffed.form.merge and any(draft.sniffed.lacks(column) for column in asked),
        channels={name: source(name) for name in draft.picks if name not in _NO_CHANNELS},
        inclination=source("inclination") if tilt else None,
        orientation=source("orientation") if tilt else None,
        time=source("time") if "time" in draft.picks else None,
        run=draft.picks["run"].terms[0].column if "run" in draft.picks else None,
    )


def _clocked(draft: Draft, found: dict[str, Unit], layout: Layout) -> tuple[Layout, list[str]]:
    """Return the layout with its sample time, restarts and duplicates, and why."""
    lines: list[str] = []
    if "time" in draft.picks:
        column = draft.picks["time"].terms[0].column
        step = np.diff(draft.sniffed.columns[column])
        if "run" not in draft.picks and (step < 0).any():
            layout = replace(layout, new_run_at_restart=True)
            lines.append(f"runs: a new one at each restart, because time goes back {(step < 0).sum()} time(s)")
        if (step == 0).any():
            layout = replace(layout, duplicates="first")
            row = int(np.argmax(step == 0)) + 1
            lines.append(f"not sure: time stands still at {(step == 0).sum()} row(s), first at row {row}: "
                         "the first of such rows is kept")  # fmt: skip
    speed = _estimated(draft, found)
    if speed is None:
        return layout, lines
    if layout.time is None:
        rounded = round(speed.value, 3)
        value = rounded if rounded > 0 and not speed.contradicts(rounded) else float(f"{speed.value:.4g}")
        lines.append(f"sample time {1e3 * value:g} ms, because positions and velocities agree at {speed}")
        return replace(layout, sample_time=value), lines
    nominal = nominal_step(draft, found)
    if speed.contradicts(nominal):
        lines.append(f"sample time estimated, because positions and velocities agree at {speed}, "
                     f"not at the {1e3 * nominal:g} ms of the time column")  # fmt: skip
        return replace(layout, estimate=True), lines
    return layout, lines


def _estimated(draft: Draft, found: dict[str, Unit]) -> SampleTime | None:
    names = [name for name in (*MOTOR_POSITIONS, *_VELOCITIES) if name in draft.picks]
    factors = {"deg": np.pi / 180, "deg/s": np.pi / 180, "rpm": np.pi / 30}
    channels = {name: factors.get(found[name][0], 1.0) * draft.values(name) for name in names}
    try:
        return estimate_sample_time(channels, draft.runs())
    except DataError:
        return None


def _why(draft: Draft, found: dict[str, Unit], name: str) -> str:
    pick = draft.picks[name]
    unit = f"; [{found[name][0]}], because {found[name][2]}" if name in found else ""
    return ("" if pick.sure else "NOT SURE: ") + f"{pick.why}{unit}"


def _line(draft: Draft, found: dict[str, Unit], name: str) -> str:
    pick = draft.picks[name]
    columns = " and ".join(say(term.column) for term in pick.terms)
    unit = f" [{found[name][0]}]" if name in found else ""
    doubt = "" if pick.sure else "not sure: "
    reason = f"{pick.why}; {found[name][2]}" if name in found else pick.why
    return f"{doubt}{name} from {columns}{unit}: because {reason}"


def _checks(draft: Draft) -> list[str]:
    """Say whether the platform rises with the redefined inputs, as the signs of the public face ask."""
    motors, platform = draft.motors(), draft.platform()
    if motors is None or not platform or len(motors) < 4 * _NECK_LAG:
        return []
    inputs, lines = redefine(motors), []
    for axis, u, name in (("pitch", inputs[:, 0], "theta_i"), ("roll", inputs[:, 1], "phi_i")):
        r, _ = lagged(u, platform[axis], _NECK_LAG)
        if r < -0.5:
            lines.append(f"not sure: {axis} falls as {name} rises (correlation {r:.2f}); if so, write `sign = -1`")
        else:
            lines.append(f"check: {axis} and {name} of the motors have correlation {r:.2f}")
    return lines


def _left_out(draft: Draft) -> list[str]:
    lines = [f"ignored: {say(column)}: because it holds words" for column in draft.sniffed.words]
    used = draft.used()
    for column in draft.sniffed.columns:
        if column in used:
            continue
        title = draft.titles.get(column)
        if np.isnan(draft.sniffed.columns[column]).all():
            reason = "it is empty"
        elif column in draft.passed_over:
            reason = draft.passed_over[column]
        elif title is not None and title.role == "ignored":
            reason = title.why
        elif column not in draft.moving:
            reason = "it never changes"
        elif title is not None and title.role != "unknown":
            reason = f"{title.why}, but a set of three motors or a better name was not found with it"
        else:
            reason = ("its name says nothing, and " if title else "") + "nothing in its data tells what it is"
        lines.append(f"ignored: {say(column)}: because {reason}")
    return lines


def _missing(draft: Draft, layout: Layout) -> tuple[str, ...]:
    """Return what a recording needs and the layout does not give, with candidates."""
    free = _listed(draft.free())
    lines = []
    absent = [name for name in SET_POINTS if name not in draft.picks]
    if absent:
        hint = "; where only positions were logged, take them as set-points too" if draft.has(MOTOR_POSITIONS) else ""
        lines.append(f"{', '.join(absent)}: candidates are {free}{hint}")
    axes = [name for name in ("pitch", "roll") if name not in draft.picks and layout.inclination is None]
    if axes:
        named = [c for c, title in draft.titles.items() if title.role in ("yaw", "inclination", "orientation")]
        lines.append(
            f"{', '.join(axes)}: candidates are {_listed([*named, *(c for c in draft.free() if c not in named)])}"
        )
    if layout.time is None and layout.sample_time is None:
        lines.append("the sample time: no column rises by equal steps; write `sample_time_s = 0.02` into [time]")
    return tuple(lines)


def _listed(columns: list[Column]) -> str:
    return ", ".join(repr(column) for column in columns[:12]) or "none of the columns"
