"""Import of a log through a layout as a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, SettingsError, SoftneckError, Vector, as_path, to_si

from ..recording._channels import may_miss, si_unit
from ..recording._files import integers, numbers, read_table
from ..recording._recording import Recording, check_rising, median_step, uneven_steps
from ..recording._resampling import Samples, mean_step, resample, split_at_gaps, without_duplicates
from ..recording._wraps import unwrap
from ._clocks import (
    axis_rotations,
    estimate_sample_time,
    fill_gaps,
    integrate_rates,
    may_be_empty,
    merge_clocks,
    pitch_roll,
    read_times,
)
from ._layout import Column, Layout, Source
from ._odd_clocks import spread_double_stamps
from ._robot_guess import NamedColumns, guess_robot
from ._table_format import WITHIN, self_described_table, without_remarks
from .formats._mat import mat_arrays, table_of
from .formats._mcap import mcap_table
from .formats._shapes import reshaped
from .formats._sheets import sheet_cells, sheet_table
from .formats._text import format_of

if TYPE_CHECKING:
    import pandas as pd

    from softneck.robot import Robot

# Share of a channel's samples that may exceed a limit.
_MAX_GLITCH_SHARE = 0.01
# A wrong unit is off by a factor of 57. Up to half beyond the range it may be another winch, which gives a warning.
_WRONG_UNIT_RATIO = 1.5
# A placeholder for missed samples is a repeated whole number of this magnitude, this many times larger than all other
# values, of which there are several.
_MIN_PLACEHOLDER, _PLACEHOLDER_RATIO, _MIN_VALUES = 90.0, 10.0, 20
# [turns] Positions this close to whole turns from their set-points are of an encoder of one turn.
_WHOLE_TURN_TOLERANCE = 0.02
# A position more turns away from its set-point is in another unit.
_MOST_TURNS = 4.5
# [turns] Larger numbers are in no unit of angles.
_MAX_TURNS = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class ImportResult:
    """A recording and the importer's notes for the user."""

    recording: Recording
    notes: tuple[str, ...] = field(default=())


def import_log(
    path: str | Path,
    layout: Layout | None = None,
    *,
    motors: Sequence[str] = (),
    positions: Sequence[str] = (),
    outputs: Sequence[str] = (),
    sample_time: float | None = None,
) -> ImportResult:
    """Read a log as a recording, by a layout or by its columns.

    Args:
        layout: of the log; None: `motors` and the like name its columns by title or index, and those that are not
            named follow from titles, units and motion.
        sample_time: of a log without a clock [s], if columns are named.

    Raises:
        FileFormatError: no such file or no table.
        DataError: a column is missing or holds no numbers, or the times do not fit.

    Example:
        >>> import softneck
        >>> from pathlib import Path
        >>> from softneck.signals import guess_layout
        >>> rows = [f"{k * 20},{k},0,0,{k / 9:.2f},{-k / 9:.2f}" for k in range(200)]
        >>> text = "\\n".join(["time [ms],target_1,target_2,target_3,pitch [deg],roll [deg]", *rows])
        >>> _ = Path("log.csv").write_text(text, encoding="utf-8")
        >>> result = softneck.import_log("log.csv", guess_layout("log.csv").layout)
        >>> len(result.recording), result.recording.sample_time
        (200, 0.02)
    """
    source = as_path(path)
    named = NamedColumns(tuple(motors), tuple(outputs), tuple(positions))
    if layout is None and named != NamedColumns():
        found = guess_robot(source, named, sample_time=sample_time)
        done = import_log(source, found.layout)
        return ImportResult(done.recording, (*found.lines, *done.notes))
    if not isinstance(layout, Layout) or named != NamedColumns():
        raise SettingsError(
            "either a layout (`read_layout`, `guess_layout`) or columns (`motors=`, `outputs=`) are needed; got a "
            f"{type(layout).__name__}{' and columns' if named != NamedColumns() else ''}."
        )
    frame = read_log(source, layout)
    if layout.rows is not None:
        frame = frame.iloc[layout.rows[0] : layout.rows[1]].reset_index(drop=True)
    try:
        # Damaged logs hold huge numbers; checks below refuse them, so numpy need not warn.
        with np.errstate(all="ignore"):
            return _import_frame(frame, layout)
    except SoftneckError as error:
        raise DataError(f"{source}: {error}") from error


def read_log(source: Path, layout: Layout) -> pd.DataFrame:
    """Return the table of a log, by its file format."""
    return reshaped(_raw_log(source, layout)).frame


def _raw_log(source: Path, layout: Layout) -> pd.DataFrame:
    kind, form = format_of(source), layout.form
    if layout.variable is not None and kind != "mat":
        raise DataError(f"{source}: the layout's `variable` is for a `.mat` file.")
    if layout.sheet is not None and kind != "sheet":
        raise DataError(f"{source}: the layout's `sheet` is for a spreadsheet.")
    if kind == "mat":
        return table_of(source, mat_arrays(source), layout.variable, tuple(map(str, _columns(layout))))
    if kind == "mcap":
        return mcap_table(source)
    if kind == "sheet":
        _, cells = sheet_cells(source, layout.sheet)
        return sheet_table(cells, header=form.header, skip=form.skip, unit_row=form.unit_row)
    if kind in WITHIN:
        return self_described_table(source, kind, form.encoding)
    frame = without_remarks(read_table(source, ".parquet" if kind == "parquet" else ".csv", form))
    frame.columns = [name.strip() if isinstance(name, str) else name for name in frame.columns]
    return frame


def _columns(layout: Layout) -> tuple[Column, ...]:
    sources = [*layout.channels.values(), layout.inclination, layout.orientation, layout.time]
    named = [term.column for source in sources if source is not None for term in source.terms]
    q = layout.quaternion
    named += [] if q is None else [q.w, q.x, q.y, q.z]
    return (*named, layout.run) if layout.run is not None else tuple(named)


def _import_frame(frame: pd.DataFrame, layout: Layout) -> ImportResult:
    channels = {name: _values(frame, source, name, layout) for name, source in layout.channels.items()}
    if layout.inclination is not None and layout.orientation is not None:
        i = _values(frame, layout.inclination, "pitch", layout)
        o = _values(frame, layout.orientation, "pitch", layout)
        channels["pitch"], channels["roll"] = pitch_roll(i, o)
    if (q := layout.quaternion) is not None:
        parts = [
            numbers(_column(frame, c, "pitch"), str(c), missing=True, nan_words=True) for c in (q.w, q.x, q.y, q.z)
        ]
        turned = axis_rotations(np.column_stack(parts))
        channels["pitch"], channels["roll"] = turned[q.pitch], turned[q.roll]
    samples, sample_time, notes = _make_equidistant(frame, layout, channels)
    recording = Recording(samples.time, sample_time, samples.channels, samples.run, layout.robot)
    notes += _refuse_range(layout, recording.channels)
    if not np.ptp(recording.set_points, axis=0).any():
        notes += ("warning: no set-point ever changes: nothing can be identified from this log",)
    return ImportResult(recording, notes)


def _refuse_range(layout: Layout, channels: Mapping[str, Vector]) -> tuple[str, ...]:
    """Raise DataError if motors exceed their range by far; return a warning if set-points exceed it a little."""
    motors, robot = layout.robot.motors, layout.robot
    warnings: list[str] = []
    for j, name in (*enumerate(robot.set_points), *enumerate(robot.motor_positions)):
        bounds = [abs(limit[j]) for limit in (motors.setpoint_min, motors.setpoint_max) if limit is not None]
        reached = np.abs(channels.get(name, np.zeros(1)))
        limit = max(bounds, default=np.inf) * to_si(motors.unit)[0]
        if (reached > limit * _WRONG_UNIT_RATIO).mean() > _MAX_GLITCH_SHARE:
            raise DataError(_range_message(layout, name, float(np.nanmax(reached)), limit))
        if name in robot.set_points and (reached > 1.001 * limit).mean() > _MAX_GLITCH_SHARE:
            warnings.append(f"warning: {_range_message(layout, name, float(np.nanmax(reached)), limit)}")
    return tuple(warnings[:1])


def _range_message(layout: Layout, name: str, reach: float, limit: float) -> str:
    """Return a message for a motor channel of magnitude `reach` and a robot's `limit`, both in SI units."""
    unit = to_si(layout.robot.motors.unit)[1]
    source = layout.channels[name]
    turned = reach / (2.0 * np.pi) if unit == "rad" else 0.0
    turns_said = f", which is {turned:.0f} turns" if turned > 1.5 else ", more than a turn" if turned > 1.0 else ""
    hint = "is `factor` right?"
    if unit == "rad" and turned > _MAX_TURNS:
        hint = 'are they an encoder\'s counts (`unit = "rad", factor = 6.2832 / counts of a turn`)?'
    elif source.unit in ("rad", "rad/s"):
        meant = "deg" if source.unit == "rad" else "deg/s"
        hint = f'is it in degrees (`unit = "{meant}"`)?'
    return (
        f"`{name}` reaches {reach:.4g} {unit}{turns_said}; the motors' range is {limit:.4g} {unit}. Fix its line in "
        f"the layout: {hint} If the robot does go so far, say so by `setpoint_max` in a robot.toml and --robot."
    )


def _make_equidistant(
    frame: pd.DataFrame, layout: Layout, channels: Mapping[str, Vector]
) -> tuple[Samples, float, tuple[str, ...]]:
    """Return equidistant samples, their sample time [s], and notes."""
    run = np.zeros(len(frame), dtype=np.int64)
    if layout.run is not None:
        run = integers(_column(frame, layout.run, "run"))
    if layout.time is None:
        sample_time, notes = _sample_time(layout, channels, run, None)
        if sample_time is None:
            raise DataError("the layout gives neither a time column nor `sample_time_s`; give one.")
        samples, jumps = _unwrapped(Samples(_row_numbers(run) * sample_time, run, channels), layout.robot)
        samples, more = integrate_rates(samples, layout.channels)
        return samples, sample_time, notes + jumps + more
    time, notes = read_times([_column(frame, term.column, "time") for term in layout.time.terms], layout.time)
    if layout.new_run_at_restart and run.size:
        run[1:] = np.cumsum((np.diff(time) < 0) | (np.diff(run) != 0))
        run[0] = 0
        notes += (f"{run[-1] + 1} run(s), by restarts of the time column",)
    check_rising(time, run, may_stand=True)
    samples, jumps = _unwrapped(Samples(time, run, channels), layout.robot)
    samples, spread = spread_double_stamps(samples)
    notes += jumps + spread
    if layout.merge:
        samples, note = merge_clocks(samples, layout.robot.outputs.names)
        notes += (note,)
    samples, left_out = without_duplicates(samples, layout.duplicates)
    samples, lost = fill_gaps(samples, layout.robot)
    samples, gaps = split_at_gaps(samples)
    samples, summed = integrate_rates(samples, layout.channels)
    nominal = median_step(samples.time, samples.run)
    sample_time, remarks = _sample_time(layout, samples.channels, samples.run, nominal)
    notes += left_out + lost + gaps + summed + remarks
    if sample_time is None:
        return _resample_uneven(samples, nominal, notes)
    return _recount_times(layout, samples, nominal, sample_time, notes)


def _unwrapped(samples: Samples, robot: Robot) -> tuple[Samples, tuple[str, ...]]:
    """Unwrap outputs and motor positions that jump by a full turn, and return notes; set-points may do so."""
    channels, notes, turned = dict(samples.channels), [], False
    for name in (*robot.outputs.names, *robot.motor_positions):
        if name not in channels or si_unit(name, robot) != "rad":
            continue
        channels[name], jumps = unwrap(channels[name], samples.run, 2.0 * np.pi)
        if not jumps:
            continue
        said = f"`{name}` jumps by a full turn at {jumps} row(s): unwrapped"
        half = np.pi * np.round(np.nanmedian(channels[name]) / np.pi)
        if name in robot.outputs.names and half and np.nanmax(np.abs(channels[name])) > robot.angle_limit:
            # What tendons bend stays within half a turn; a sensor mounted upside down moves about 180 deg.
            channels[name] = channels[name] - half
            said += f" and counted from {np.degrees(half):g} deg, about which it moves"
        notes.append(said)
        turned |= name in robot.motor_positions
    for name, asked in zip(robot.motor_positions, robot.set_points, strict=True):
        if name not in channels or asked not in channels or si_unit(name, robot) != "rad":
            continue
        # An encoder of one turn does not count turns: its set-point does.
        behind = channels[asked] - channels[name]
        # Messages of several clocks never have both.
        ahead = float(np.median(behind[np.isfinite(behind)])) / (2.0 * np.pi) if np.isfinite(behind).any() else 0.0
        whole = turned or abs(ahead - np.round(ahead)) < _WHOLE_TURN_TOLERANCE
        if np.round(ahead) and whole and abs(ahead) < _MOST_TURNS:
            channels[name] = channels[name] + 2.0 * np.pi * np.round(ahead)
            notes.append(f"`{name}` is {ahead:.0f} turn(s) behind its set-point: shifted")
    return Samples(samples.time, samples.run, channels), tuple(notes)


def _sample_time(
    layout: Layout, channels: Mapping[str, Vector], run: np.ndarray, nominal: float | None
) -> tuple[float | None, tuple[str, ...]]:
    """Return the sample time that overrules the column's `nominal`, and a note if velocities contradict it."""
    given = layout.sample_time
    if layout.estimate:
        found = estimate_sample_time(channels, run)
        return found.value, (f"sample time estimated from positions and velocities: {found}",)
    judged = given if given is not None else nominal
    try:
        found = estimate_sample_time(channels, run)
    except DataError:
        return given, ()
    if judged is None or not found.contradicts(judged):
        return given, ()
    hint = 'write `sample_time_s = "estimate"` in [time] to use it'
    return given, (f"warning: {1e3 * judged:g} ms does not fit: positions and velocities agree at {found}; {hint}",)


def _resample_uneven(
    samples: Samples, nominal: float, notes: tuple[str, ...]
) -> tuple[Samples, float, tuple[str, ...]]:
    """Resample at the mean step, unless the samples are equidistant."""
    if not uneven_steps(samples.time, nominal, samples.run).any():
        return samples, nominal, notes
    step = 1e3 * np.diff(samples.time)[np.diff(samples.run) == 0]
    sample_time = mean_step(samples)
    even, shift = resample(samples, sample_time)
    note = (
        f"the time column is uneven ({step.min():.4g} to {step.max():.4g} ms a step): resampled at "
        f"{1e3 * sample_time:.6g} ms, largest shift of a sample {1e3 * shift:.3g} ms"
    )
    return even, sample_time, (*notes, note)


def _recount_times(
    layout: Layout, samples: Samples, nominal: float, sample_time: float, notes: tuple[str, ...]
) -> tuple[Samples, float, tuple[str, ...]]:
    """Replace the times by row numbers times a sample time that is more reliable than the time column."""
    whose = "the estimated" if layout.estimate else "the layout's"
    if abs(nominal - sample_time) > 1e-3 * sample_time:
        notes += (f"the time column says {1e3 * nominal:g} ms a sample; {whose} {1e3 * sample_time:.4g} ms is used",)
    if uneven_steps(samples.time, nominal, samples.run).any():
        notes += (f"the time column is uneven, but {whose} sample time counts rows: nothing was resampled",)
    return Samples(_row_numbers(samples.run) * sample_time, samples.run, samples.channels), sample_time, notes


def _row_numbers(run: np.ndarray) -> np.ndarray:
    """Return the number of each row within its run."""
    first = np.concatenate([[0], np.flatnonzero(np.diff(run)) + 1]) if run.size else np.zeros(0, dtype=np.int64)
    return np.arange(run.size) - np.repeat(first, np.diff(np.append(first, run.size)))


def _values(frame: pd.DataFrame, source: Source, channel: str, layout: Layout) -> Vector:
    total = np.zeros(len(frame))
    for term in source.terms:
        column = _column(frame, term.column, channel)
        missing = may_miss(channel, layout.robot) or may_be_empty(layout, channel)
        cells = numbers(column, str(term.column), missing=missing, nan_words=True)
        if missing:
            _refuse_placeholder(cells, term.column)
        total = total + term.factor * cells
    if total.size and np.isnan(total).all():
        named = ", ".join(f"`{term.column}`" for term in source.terms)
        raise DataError(
            f"column {named} for `{channel}` holds no number in any of its {total.size} rows; is its sensor connected? "
            "Name another column, or leave the channel out of the layout where a recording does not need it."
        )
    return (source.sign * to_si(source.unit)[0]) * total


def _refuse_placeholder(cells: Vector, name: Column) -> None:
    """Raise DataError if a number such as -999 marks missed samples."""
    seen = np.unique(cells[np.isfinite(cells)])
    far = seen[int(np.argmax(np.abs(seen)))] if seen.size > _MIN_VALUES else 0.0
    if abs(far) < _MIN_PLACEHOLDER or far != round(far):
        return
    rows, rest = int((cells == far).sum()), float(np.abs(seen[seen != far]).max())
    if rows > 1 and abs(far) > _PLACEHOLDER_RATIO * rest:
        raise DataError(
            f"column `{name}` holds {far:g} in {rows} rows, {abs(far) / rest:.0f} times as far as all others: does it "
            "mark missed samples? Leave these cells empty."
        )


def _column(frame: pd.DataFrame, name: Column, channel: str) -> pd.Series:
    """Return a column by its name, or by its index."""
    places = [place for place, title in enumerate(frame.columns) if title == name]
    if len(places) > 1:
        raise DataError(f"column `{name}` for `{channel}` occurs {len(places)} times in the file; use its index.")
    if not places and isinstance(name, int) and 0 <= name < frame.shape[1]:
        places = [name]
    if not places:
        listed = ", ".join(str(title) for title in frame.columns)
        raise DataError(f"column `{name}` for `{channel}` is not in the file; it has {listed}.")
    return frame.iloc[:, places[0]]
