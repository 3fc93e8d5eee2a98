"""A layout proposed from an unknown log: `softneck import --guess`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from softneck.core import AMBIGUOUS, DataError, ReprMixin, SettingsError, to_si
from softneck.robot import Robot

from ..recording._channels import MOTOR_POSITIONS, MOTOR_VELOCITIES, NECK, OUTPUTS, SET_POINTS, redefine
from ..recording._resampling import jitter
from ._clocks import SampleTime, estimate_sample_time
from ._draft import SURE, Doubt, Draft, column_label, percent
from ._guess_names import by_names, drop_or_turn_quaternion, of_one_output, one_axis, use_positions_as_inputs
from ._guess_shapes import by_shapes, max_correlation, pick_clock
from ._guess_units import Unit, nominal_step, units, unread_clocks
from ._layout import ONE_AXIS, Column, Layout, Source, Term, layout_toml
from ._odd_clocks import double_stamps, mean_of_steps, rows_of_stamp
from ._table_format import SniffResult, sniff

_TILT = (*OUTPUTS, "inclination", "orientation", "pitch_reference", "roll_reference")
_GROUPS = {"motor set-points": SET_POINTS, "motor positions": MOTOR_POSITIONS, "motor velocities": MOTOR_VELOCITIES}
# However strong the correlation, a sign that contradicts the titles deserves a question.
_MOST_SURE = 0.89


def doubts_of(draft: Draft, found: dict[str, Unit]) -> list[Doubt]:
    """Return the decisions on columns and units with less than 90 % confidence, the least certain first."""
    doubts = [*_column_doubts(draft), *_unit_doubts(draft, found)]
    if draft.quaternion is not None and draft.quaternion_sure < SURE:
        q = draft.quaternion
        taken = f"pitch about {q.pitch}, roll about {q.roll}"
        doubts.append(Doubt("axes of the sensor", OUTPUTS, taken, draft.quaternion_sure, draft.quaternion_why))
    return sorted(doubts, key=lambda doubt: doubt.confidence)


def _column_doubts(draft: Draft) -> list[Doubt]:
    doubts: list[Doubt] = []
    taken: set[str] = set()
    for about, channels in [*_GROUPS.items(), *((name, (name,)) for name in draft.picks)]:
        names = tuple(name for name in channels if name in draft.picks and name not in taken)
        taken |= set(names)
        sure = min((draft.picks[name].confidence for name in names), default=1.0)
        if sure < SURE:
            columns = dict.fromkeys(term.column for name in names for term in draft.picks[name].terms)
            doubts.append(Doubt(about, names, ", ".join(map(column_label, columns)), sure, draft.picks[names[0]].why))
    return doubts


def _unit_doubts(draft: Draft, found: dict[str, Unit]) -> list[Doubt]:
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
        choices += (f"gon{rate}",) if unit.why == AMBIGUOUS["grad"] else ()
        other = tuple(choice for choice in choices if choice != unit.name)
        doubts.append(Doubt(f"unit of {about}", names, unit.name, unit.confidence, unit.why, other))
    return doubts


def jitter_doubt(shortest: float, longest: float, usual: float) -> Doubt:
    """Return the doubt in a clock that jitters: rows may be equidistant and their stamps [s] late."""
    why = (
        f"steps are {1e3 * shortest:.3g} to {1e3 * longest:.3g} ms, of all lengths between: the clock jitters and no "
        f"gap is seen; if rows were taken evenly write `sample_time_s = {usual:.4g}` into [time]"
    )
    return Doubt("clock", ("time",), "rows as they are stamped, resampled", 0.8, why)


def settle_doubt(layout: Layout, doubt: Doubt, choice: str) -> Layout:
    """Return the layout with another choice for a doubt."""
    if choice not in doubt.choices:
        raise SettingsError(f"{doubt.about}: `{choice}` is none of {', '.join(doubt.choices) or 'no choices'}.")
    if doubt.about == "rows of one time stamp":
        return replace(layout, duplicates=choice)
    if doubt.about.startswith("sign of"):
        return _change_sources(layout, doubt.channels, sign=-1.0)
    return _change_sources(layout, doubt.channels, unit=choice)


def _change_sources(layout: Layout, channels: Sequence[str], *, unit: str | None = None, sign: float = 1.0) -> Layout:
    """Return the layout with another unit or sign in some channels, the tilt or the time."""
    sources = {name: source for name, source in layout.channels.items() if name in channels}
    found = {n: replace(s, unit=unit or s.unit, sign=sign * s.sign) for n, s in sources.items()}
    rest = {
        # The factor of a time belongs to its old unit.
        name: replace(
            source,
            unit=unit,
            terms=source.terms if name != "time" or len(source.terms) > 1 else (replace(source.terms[0], factor=1.0),),
        )
        for name in ("inclination", "orientation", "time")
        if unit is not None and name in channels and (source := getattr(layout, name)) is not None
    }
    return replace(layout, channels={**layout.channels, **found}, **rest)


_NO_CHANNELS = ("time", "run", "inclination", "orientation")
# Longest lag of the platform behind its motors [samples]: half a second at 20 ms.
_NECK_LAG = 25
# Fewer rows have no step to compare with another.
_MIN_ROWS = 3


@dataclass(frozen=True, slots=True, repr=False)
class Guess(ReprMixin):
    """A proposed layout, with the reason for each line.

    Attributes:
        layout: the layout, possibly incomplete.
        text: the layout as TOML with a comment for each line; missing entries at the end.
        lines: columns in use and ignored, each with its reason, and uncertain decisions.
        missing: required entries that were not found, each with candidates and a line for the layout.
        doubts: decisions below 90 % confidence, the least certain first.
    """

    layout: Layout
    text: str
    lines: tuple[str, ...]
    missing: tuple[str, ...]
    doubts: tuple[Doubt, ...] = ()
    _remarks: Mapping[str, str] = field(default_factory=dict, repr=False)
    _head: str = field(default="", repr=False)
    _table: SniffResult | None = field(default=None, repr=False, compare=False)

    def settle_doubt(self, doubt: Doubt, choice: str | None = None) -> Guess:
        """Return the guess with one doubt settled: the choice made, or another.

        Raises:
            SettingsError: `choice` is none of the doubt's choices.
        """
        layout = self.layout if choice is None else settle_doubt(self.layout, doubt, choice)
        said = f"{doubt.about}: {choice or doubt.taken}, as you answered"
        remarks = {**self._remarks, **dict.fromkeys(doubt.channels, said)}
        return self._rewrite(layout, remarks, self.missing, tuple(one for one in self.doubts if one is not doubt))

    def with_sample_time(self, sample_time: float) -> Guess:
        """Return the guess of a log without a clock with its sample time [s], and a doubt for what may be one."""
        missing = tuple(line for line in self.missing if not line.startswith(_NO_CLOCK))
        doubts = () if self._table is None else unread_clocks(self._table, sample_time)
        remarks = {**self._remarks, "sample_time": "; ".join(["as given", *(f"NOT SURE: {one}" for one in doubts)])}
        guess = replace(self, lines=(*self.lines, *(f"not sure: {doubt}" for doubt in doubts)))
        layout = replace(self.layout, sample_time=sample_time)
        return guess._rewrite(layout, remarks, missing, (*doubts, *self.doubts))

    def _rewrite(
        self, layout: Layout, remarks: Mapping[str, str], missing: tuple[str, ...], doubts: tuple[Doubt, ...]
    ) -> Guess:
        text = self._head + layout_toml(layout, remarks=remarks, open_ends=[f"MISSING {line}" for line in missing])
        return replace(self, layout=layout, text=text, missing=missing, doubts=doubts, _remarks=remarks)


_NO_CLOCK = "the sample time"
# Candidates named in a line of `missing`; the page and the notes list all.
_MAX_CANDIDATES = 3
_NO_MOTORS = "no column is of a motor; record their set-points, positions or velocities too"


def guess_layout(path: str | Path, *, robot: Robot = NECK, output: str | None = None) -> Guess:
    """Return a layout for an unknown log: a text, spreadsheet, Parquet, MAT or MCAP file.

    Args:
        robot: the neck of the log, for its motors' range.
        output: of the neck, "pitch" or "roll", that is taken alone; None: both.

    Raises:
        FileFormatError: no such file, or no table.
        DataError: the table has too few columns for a recording.
    """
    # Damaged logs hold infinities; numpy's warnings about their sums would not help the user.
    with np.errstate(all="ignore"):
        return _guess(Path(path), robot if output is None else of_one_output(robot, output))


def _guess(path: Path, neck: Robot) -> Guess:
    sniffed = sniff(path)
    rows = max((values.size for values in sniffed.columns.values()), default=0)
    if rows < _MIN_ROWS:
        raise DataError(f"{path}: has {rows} row(s) of numbers, too few for a recording; record longer.")
    draft = Draft(sniffed)
    by_names(draft)
    by_shapes(draft)
    use_positions_as_inputs(draft)
    drop_or_turn_quaternion(draft)
    draft.order()
    found = units(draft)
    moved = all(name in draft.picks for name in SET_POINTS)
    robot = one_axis(draft, _other_axis(draft), neck) if moved else neck
    check_lines, sign_doubts = _check_signs(draft)
    layout, clock_lines, clock_doubts = _choose_clock(draft, found, _layout(draft, found, robot))
    missing = _missing(draft, layout)
    other_doubts = list(sign_doubts)
    if sniffed.doubt:
        other_doubts.append(Doubt("rows and columns", ("file",), "transposed", 0.8, sniffed.doubt))
    if robot is not neck:  # a log of one angle, although a neck has two
        axis, other = robot.outputs.names[0], "roll" if robot.outputs.names[0] == "pitch" else "pitch"
        why = f"no column is {other} or follows the motors like it, so the robot has one output; log {other} too if it"
        other_doubts.append(Doubt(ONE_AXIS, (axis,), f"{axis} only", 0.8, f"{why} tilts"))
    doubts = sorted([*doubts_of(draft, found), *clock_doubts, *other_doubts], key=lambda doubt: doubt.confidence)
    remarks = {name: _why(draft, found, name) for name in draft.picks}
    remarks["file"] = "; ".join(line.removeprefix("file: ") for line in draft.sniffed.lines)
    remarks |= {doubt.channels[0]: f"{remarks[doubt.channels[0]]}; NOT SURE: {doubt}" for doubt in other_doubts}
    remarks["sample_time"] = "; ".join([*clock_lines, *(f"NOT SURE: {doubt}" for doubt in clock_doubts)])
    remarks["quaternion"] = _mark(draft.quaternion_sure) + draft.quaternion_why
    lines = [*draft.sniffed.lines, *(_line(draft, found, name) for name in draft.picks), *clock_lines]
    if draft.quaternion is not None:
        lines.append(
            _mark_line(f"pitch and roll from a quaternion: because {draft.quaternion_why}", draft.quaternion_sure)
        )
    if layout.merge:
        lines.append("rows of several clocks, because set-points have empty cells: merged at the rows of the outputs")
    lines += [f"not sure: {doubt}" for doubt in doubts if doubt.about == ONE_AXIS]
    lines += [f"not sure: {doubt.why} ({percent(doubt.confidence)} sure of {doubt.taken})" for doubt in clock_doubts]
    lines += [*check_lines, *_left_out(draft)]
    head = f"# Proposed by `softneck import --guess` for {path.name!r}; edit it.\n\n"
    guess = Guess(layout, "", tuple(lines), missing, tuple(doubts), remarks, head, sniffed)
    return guess._rewrite(layout, remarks, missing, guess.doubts)


def _layout(draft: Draft, found: dict[str, Unit], robot: Robot) -> Layout:
    def source(name: str) -> Source:
        pick, unit = draft.picks[name], found[name]
        terms = tuple(Term(term.column, unit.factor * term.factor) for term in pick.terms)
        return Source(terms, unit.name, pick.sign, pick.integrate)

    tilt = "inclination" in draft.picks and "orientation" in draft.picks
    set_point_columns = [term.column for name in SET_POINTS if name in draft.picks for term in draft.picks[name].terms]
    absent = {name for name in draft.picks if any(name.startswith(axis) for axis in OUTPUTS)
              and not name.startswith(robot.outputs.names)}  # fmt: skip
    return replace(
        draft.sniffed.form,
        # A measurement may be missed, a set-point may not: an empty cell means that it holds.
        merge=draft.sniffed.form.merge and any(draft.sniffed.lacks(column) for column in set_point_columns),
        channels={name: source(name) for name in draft.picks if name not in _NO_CHANNELS and name not in absent},
        inclination=source("inclination") if tilt else None,
        orientation=source("orientation") if tilt else None,
        quaternion=draft.quaternion,
        time=source("time") if "time" in draft.picks else None,
        run=draft.picks["run"].terms[0].column if "run" in draft.picks else None,
        robot=robot,
    )


def _choose_clock(draft: Draft, found: dict[str, Unit], layout: Layout) -> tuple[Layout, list[str], list[Doubt]]:
    """Return the layout with its sample time, restarts and duplicates, lines with reasons, and doubts."""
    lines: list[str] = []
    doubts: list[Doubt] = []
    if (counted := _counted_rows(draft, found)) is not None:
        step, why, sure = counted
        lines.append(f"sample time {1e3 * step:.6g} ms, because {why}")
        why = f"{why}; the rows are counted, {1e3 * step:.6g} ms each"
        doubts.append(Doubt("sample time", ("sample_time",), f"{1e3 * step:.6g} ms", sure, why))
        return replace(layout, time=None, sample_time=step), lines, doubts
    if "time" in draft.picks:
        column = draft.picks["time"].terms[0].column
        step = np.diff(draft.sniffed.columns[column])
        one = len(draft.picks["time"].terms) == 1
        if "run" not in draft.picks and one and (step < 0).any():
            layout = replace(layout, new_run_at_restart=True)
            lines.append(f"runs: a new one at each restart, because time goes back {(step < 0).sum()} time(s)")
        values = draft.sniffed.columns[column]
        if one and double_stamps(values, np.zeros(values.size)).sum() == (np.diff(values) == 0).sum() > 0:
            lines.append("time: a stamp that occurs twice, with a step of two behind it, is set between its neighbours")
        elif one and (step == 0).any():
            layout = replace(layout, duplicates="first")
            if not layout.merge:
                why = f"time stands still at {(step == 0).sum()} row(s), first at row {np.argmax(step == 0) + 1}"
                doubts.append(Doubt("rows of one time stamp", ("time",), "the first", 0.8, why, ("last",)))
        if one and not layout.merge and (limits := jitter(draft.values("time"))) is not None:
            scale = nominal_step(draft, found) / limits[2]
            doubts.append(jitter_doubt(*(scale * limit for limit in limits)))
    speed = _estimate_from_rates(draft, found)
    if speed is None:
        return layout, lines, doubts
    if layout.time is None:
        rounded = round(speed.value, 3)
        value = rounded if rounded > 0 and not speed.contradicts(rounded) else float(f"{speed.value:.4g}")
        lines.append(f"sample time {1e3 * value:g} ms, because positions and velocities agree at {speed}")
        return replace(layout, sample_time=value), lines, doubts
    nominal = nominal_step(draft, found)
    if speed.contradicts(nominal):
        lines.append(f"sample time estimated, because positions and velocities agree at {speed}, "
                     f"not at the {1e3 * nominal:g} ms of the time column")  # fmt: skip
        return replace(layout, estimate=True), lines, doubts
    return layout, lines, doubts


def guess_clock(table: SniffResult, taken: Collection[Column]) -> tuple[Layout, list[str], list[Doubt]] | None:
    """Return the clock of a log of any robot as a layout without channels, with reasons and doubts; None without one.

    `taken`: columns that are motors or outputs.
    """
    draft = Draft(
        replace(table, columns={name: x for name, x in table.columns.items() if name not in taken}), neck=False
    )
    by_names(draft)
    pick_clock(draft)
    found = units(draft)
    layout, lines, doubts = _choose_clock(draft, found, _layout(draft, found, NECK))
    if layout.time is None and layout.sample_time is None:
        return None
    draft.picks = {"time": draft.picks["time"]} if layout.time is not None else {}
    lines = [*(_line(draft, found, name) for name in draft.picks), *lines]
    return replace(layout, channels={}, estimate=False), lines, [*doubts_of(draft, found), *doubts]


_STEP_TITLES = {"dt", "delta t", "deltat", "ts", "sample time", "time step", "timestep", "step s", "period", "interval"}


def _counted_rows(draft: Draft, found: dict[str, Unit]) -> tuple[float, str, float] | None:
    """Return the sample time [s] of a log without a time in each row, the reason, and the confidence."""
    if "time" in draft.picks:
        column = draft.picks["time"].terms[0].column
        count = rows_of_stamp(draft.sniffed.columns[column]) if len(draft.picks["time"].terms) == 1 else None
        if count is None or draft.sniffed.form.merge:
            return None
        return (
            nominal_step(draft, found) / count,
            f"{column_label(column)} stands still for {count} rows at a time",
            0.8,
        )
    for column, title in draft.titles.items():
        values = draft.sniffed.columns[column]
        scale = to_si(title.unit)[0] if title.unit and title.quantity == "s" else 1.0
        if (title.family in _STEP_TITLES or str(column).lower() in _STEP_TITLES) and (mean := mean_of_steps(values)):
            if title.unit is None and not _FASTEST_S < mean < _SLOWEST_S:
                scale = 1e-3
            return scale * mean, f"{column_label(column)} holds the time since the row before", 0.85
        if title.role == "time" and (count := rows_of_stamp(values)) is not None:
            steps = np.diff(values)
            stamp = float(np.median(steps[steps > 0.0]))
            return scale * stamp / count, f"{column_label(column)} stands still for {count} rows at a time", 0.8
    return None


# Mean steps outside of these are no seconds.
_FASTEST_S, _SLOWEST_S = 1e-5, 2.0


def _estimate_from_rates(draft: Draft, found: dict[str, Unit]) -> SampleTime | None:
    names = [name for name in (*MOTOR_POSITIONS, *MOTOR_VELOCITIES) if name in draft.picks]
    channels = {name: found[name].si * draft.values(name) for name in names}
    try:
        return estimate_sample_time(channels, draft.runs())
    except DataError:
        return None


def _sure(draft: Draft, found: dict[str, Unit], name: str) -> float:
    """Return the smaller confidence of a channel's column and unit."""
    return min(draft.picks[name].confidence, found[name].confidence if name in found else 1.0)


def _why(draft: Draft, found: dict[str, Unit], name: str) -> str:
    unit = f"; [{found[name].name}], because {found[name].why}" if name in found else ""
    return f"{_mark(_sure(draft, found, name))}{draft.picks[name].why}{unit}"


def _mark(sure: float) -> str:
    return "" if sure >= SURE else f"NOT SURE ({percent(sure)}): "


def _mark_line(line: str, sure: float) -> str:
    return line if sure >= SURE else f"not sure: {line}; {percent(sure)} sure"


def _line(draft: Draft, found: dict[str, Unit], name: str) -> str:
    pick = draft.picks[name]
    columns = " and ".join(column_label(term.column) for term in pick.terms)
    unit = f" [{found[name].name}]" if name in found else ""
    reason = f"{pick.why}; {found[name].why}" if name in found else pick.why
    return _mark_line(f"{name} from {columns}{unit}: because {reason}", _sure(draft, found, name))


def _check_signs(draft: Draft) -> tuple[list[str], list[Doubt]]:
    """Check that pitch and roll rise with the redefined inputs, as the sign convention demands.

    An angle that falls is inverted, which is more probably right, and marked as doubtful.
    """
    motors, platform = draft.motors(), draft.platform()
    if motors is None or not platform or len(motors) < 4 * _NECK_LAG:
        return [], []
    inputs, lines, doubts = redefine(motors), [], []
    for axis, u, name in (("pitch", inputs[:, 0], "theta_i"), ("roll", inputs[:, 1], "phi_i")):
        if axis not in platform:
            continue
        r, _ = max_correlation(u, platform[axis], _NECK_LAG)
        if r >= -0.5:
            lines.append(f"check: {axis} and {name} of the motors have correlation {r:.2f}")
            continue
        falls = f"not sure: {axis} falls as {name} rises (correlation {r:.2f})"
        if axis not in draft.picks:  # it comes from a tilt, which has no sign
            lines.append(f"{falls}; is the order of the motors right?")
            continue
        pick = draft.picks[axis]
        draft.picks[axis] = replace(pick, sign=-pick.sign)
        lines.append(f"{falls}: inverted; if that is wrong, write `sign = {pick.sign:g}`")
        order = "; or motors 2 and 3 are swapped" if axis == "roll" else ""
        why = f"as logged {axis} falls as {name} rises (correlation {r:.2f}), and recordings have both rise{order}"
        sure = min(_MOST_SURE, 0.5 - 0.5 * r)
        doubts.append(Doubt(f"sign of {axis}", (axis,), "inverted", sure, why, ("as logged",)))
    return lines, doubts


def _left_out(draft: Draft) -> list[str]:
    lines = [f"ignored: {column_label(column)}: because it holds words" for column in draft.sniffed.words]
    q = draft.quaternion
    used = draft.used_columns() | (set() if q is None else {q.w, q.x, q.y, q.z})
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
            reason = f"it is not recognised from its {'name or ' if title else ''}data"
        lines.append(f"ignored: {column_label(column)}: because {reason}")
    return lines


def _other_axis(draft: Draft) -> list[Column]:
    """Return the columns that may be the angle that was not found."""
    roles = ("yaw", "inclination", "orientation")
    named = [c for c, title in draft.titles.items() if title.role in roles and c not in draft.used_columns()]
    return [*named, *(c for c in draft.free() if c not in named)]


def _missing(draft: Draft, layout: Layout) -> tuple[str, ...]:
    """Return the required entries that the layout lacks, each with the line that adds it."""
    lines = []
    absent = [name for name in SET_POINTS if name not in draft.picks]
    if absent:
        names = "motor_setpoint_1..3" if len(absent) == 3 else ", ".join(absent)
        free = draft.free()
        lines.append(f"{names}: {_to_name(absent[0], free, 'rad') if free else _NO_MOTORS}")
    axes = [name for name in layout.robot.outputs.names if name not in draft.picks]
    if axes and layout.inclination is None and layout.quaternion is None:
        lines.append(f"{', '.join(axes)}: {_to_name(axes[0], _other_axis(draft), 'deg')}")
    if layout.time is None and layout.sample_time is None:
        lines.append(f"{_NO_CLOCK}: no column rises by equal steps; say `--sample-time S`")
    return tuple(lines)


def _to_name(channel: str, candidates: list[Column], unit: str) -> str:
    """Return the layout's line for a channel, and the first columns that it may be."""
    if not candidates:
        return "no column is left that moves; record it too"
    shown = ", ".join(repr(column) for column in candidates[:_MAX_CANDIDATES]) + (
        ", ..." if candidates[_MAX_CANDIDATES:] else ""
    )
    return f"is it {shown}? Write `{channel} = {{ column = {_toml(candidates[0])}, unit = '{unit}' }}`"


def _toml(column: Column) -> str:
    return f"'{column}'" if isinstance(column, str) else str(column)
