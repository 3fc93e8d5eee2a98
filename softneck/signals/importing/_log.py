"""Foreign logs become recordings through a layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, SettingsError, SoftneckError, Vector, as_path, to_si

from ..recording._channels import may_miss
from ..recording._files import integers, numbers, read_table
from ..recording._recording import Recording, check_rising, median_step, uneven_steps
from ..recording._resampling import Samples, mean_step, resample, split_at_gaps, without_duplicates
from ._clocks import clocked, estimate_sample_time, filled, integrated, merged, pitch_roll, time_of, turns
from ._layout import Column, Layout, Source
from ._table_format import without_remarks
from .formats._encodings import format_of
from .formats._mat import mat_arrays, table_of
from .formats._mcap import mcap_table
from .formats._sheets import sheet_cells, sheet_table

if TYPE_CHECKING:
    import pandas as pd

# Part of the samples of a channel that may be anything.
_GLITCHES = 0.01
# A wrong unit is off by 57. Less than half as far again as the range may be another winch, and is told only.
_ANOTHER_UNIT = 1.5
# What stands for a missed sample is a whole number that stands there often, this much further than all others, of which
# there are many.
_STAND_IN, _FURTHER, _VARIED = 90.0, 10.0, 20
# [turns] So far no unit of angles goes.
_COUNTS_FROM = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class ImportResult:
    """A recording and what the importer did that a user should know."""

    recording: Recording
    notes: tuple[str, ...] = field(default=())


def import_log(path: str | Path, layout: Layout) -> ImportResult:
    """Read a foreign table as a recording.

    Raises:
        FileFormatError: no such file or no table.
        DataError: a column is missing, holds no numbers, or the times do not fit.

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
    if not isinstance(layout, Layout):
        raise SettingsError(f"a layout is needed (`read_layout`, `guess_layout`); got a {type(layout).__name__}.")
    frame = read_log(source, layout)
    if layout.rows is not None:
        frame = frame.iloc[layout.rows[0] : layout.rows[1]].reset_index(drop=True)
    try:
        # Damaged logs hold numbers beyond all bounds; what comes of them is refused below, without a warning beside it.
        with np.errstate(all="ignore"):
            return _imported(frame, layout)
    except SoftneckError as error:
        raise DataError(f"{source}: {error}") from error


def read_log(source: Path, layout: Layout) -> pd.DataFrame:
    """Return a log's table, by what the file is."""
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
    frame = without_remarks(read_table(source, ".parquet" if kind == "parquet" else ".csv", form))
    frame.columns = [name.strip() if isinstance(name, str) else name for name in frame.columns]
    return frame


def _columns(layout: Layout) -> tuple[Column, ...]:
    """Return all columns that a layout names."""
    sources = [*layout.channels.values(), layout.inclination, layout.orientation, layout.time]
    named = [term.column for source in sources if source is not None for term in source.terms]
    q = layout.quaternion
    named += [] if q is None else [q.w, q.x, q.y, q.z]
    return (*named, layout.run) if layout.run is not None else tuple(named)


def _imported(frame: pd.DataFrame, layout: Layout) -> ImportResult:
    channels = {name: _values(frame, source, name, layout) for name, source in layout.channels.items()}
    if layout.inclination is not None and layout.orientation is not None:
        i = _values(frame, layout.inclination, "pitch", layout)
        o = _values(frame, layout.orientation, "pitch", layout)
        channels["pitch"], channels["roll"] = pitch_roll(i, o)
    if (q := layout.quaternion) is not None:
        parts = [
            numbers(_column(frame, c, "pitch"), str(c), missing=True, nan_words=True) for c in (q.w, q.x, q.y, q.z)
        ]
        turned = turns(np.column_stack(parts))
        channels["pitch"], channels["roll"] = turned[q.pitch], turned[q.roll]
    samples, sample_time, notes = _clocked(frame, layout, channels)
    recording = Recording(samples.time, sample_time, samples.channels, samples.run, layout.robot)
    notes += _refuse_range(layout, recording.channels)
    if not np.ptp(recording.set_points, axis=0).any():
        notes += ("warning: no set-point ever changes: nothing can be identified from this log",)
    return ImportResult(recording, notes)


def _refuse_range(layout: Layout, channels: Mapping[str, Vector]) -> tuple[str, ...]:
    """Return a warning where set-points go further than the motors' range."""
    motors, robot = layout.robot.motors, layout.robot
    warnings: list[str] = []
    for j, name in (*enumerate(robot.set_points), *enumerate(robot.motor_positions)):
        bounds = [abs(limit[j]) for limit in (motors.setpoint_min, motors.setpoint_max) if limit is not None]
        reached = np.abs(channels.get(name, np.zeros(1)))
        limit = max(bounds, default=np.inf) * to_si(motors.unit)[0]
        if (reached > limit * _ANOTHER_UNIT).mean() > _GLITCHES:
            raise DataError(_beyond(layout, name, float(np.nanmax(reached)), limit))
        if name in robot.set_points and (reached > 1.001 * limit).mean() > _GLITCHES:
            warnings.append(f"warning: {_beyond(layout, name, float(np.nanmax(reached)), limit)}")
    return tuple(warnings[:1])


def _beyond(layout: Layout, name: str, reach: float, limit: float) -> str:
    """Return what to do where a motor's channel reaches `reach` and the robot `limit`, both in SI units."""
    unit = to_si(layout.robot.motors.unit)[1]
    source = layout.channels[name]
    turned = reach / (2.0 * np.pi) if unit == "rad" else 0.0
    turns_said = f", which is {turned:.0f} turns" if turned > 1.5 else ", more than a turn" if turned > 1.0 else ""
    hint = "is `factor` right?"
    if unit == "rad" and turned > _COUNTS_FROM:
        hint = 'are they an encoder\'s counts (`unit = "rad", factor = 6.2832 / counts of a turn`)?'
    elif source.unit in ("rad", "rad/s"):
        meant = "deg" if source.unit == "rad" else "deg/s"
        hint = f'is it in degrees (`unit = "{meant}"`)?'
    return (
        f"`{name}` reaches {reach:.4g} {unit}{turns_said}; the motors' range is {limit:.4g} {unit}. Fix its line in "
        f"the layout: {hint} If the robot does go so far, say so by `setpoint_max` in a robot.toml and --robot."
    )


def _clocked(
    frame: pd.DataFrame, layout: Layout, channels: Mapping[str, Vector]
) -> tuple[Samples, float, tuple[str, ...]]:
    """Return the samples at equidistant times, their sample time [s], and what was done to get there."""
    run = np.zeros(len(frame), dtype=np.int64)
    if layout.run is not None:
        run = integers(_column(frame, layout.run, "run"))
    if layout.time is None:
        sample_time, notes = _sample_time(layout, channels, run, None)
        if sample_time is None:
            raise DataError("the layout gives neither a time column nor `sample_time_s`; give one.")
        samples, more = integrated(Samples(_counted(run) * sample_time, run, channels), layout.channels)
        return samples, sample_time, notes + more
    time, notes = time_of([_column(frame, term.column, "time") for term in layout.time.terms], layout.time)
    if layout.new_run_at_restart and run.size:
        run[1:] = np.cumsum((np.diff(time) < 0) | (np.diff(run) != 0))
        run[0] = 0
        notes += (f"{run[-1] + 1} run(s), by restarts of the time column",)
    check_rising(time, run, may_stand=True)
    samples = Samples(time, run, channels)
    if layout.merge:
        samples, note = merged(samples, layout.robot.outputs.names)
        notes += (note,)
    samples, left_out = without_duplicates(samples, layout.duplicates)
    samples, lost = filled(samples, layout.robot)
    samples, gaps = split_at_gaps(samples)
    samples, summed = integrated(samples, layout.channels)
    nominal = median_step(samples.time, samples.run)
    sample_time, remarks = _sample_time(layout, samples.channels, samples.run, nominal)
    notes += left_out + lost + gaps + summed + remarks
    if sample_time is None:
        return _evened(samples, nominal, notes)
    return _recounted(layout, samples, nominal, sample_time, notes)


def _sample_time(
    layout: Layout, channels: Mapping[str, Vector], run: np.ndarray, nominal: float | None
) -> tuple[float | None, tuple[str, ...]]:
    """Return the sample time that overrules the column's `nominal`, and what velocities say of either."""
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


def _evened(samples: Samples, nominal: float, notes: tuple[str, ...]) -> tuple[Samples, float, tuple[str, ...]]:
    """Return equidistant samples as they are, and others resampled at their mean step."""
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


def _recounted(
    layout: Layout, samples: Samples, nominal: float, sample_time: float, notes: tuple[str, ...]
) -> tuple[Samples, float, tuple[str, ...]]:
    """Return the samples counted at a sample time that is known better than the time column."""
    whose = "the estimated" if layout.estimate else "the layout's"
    if abs(nominal - sample_time) > 1e-3 * sample_time:
        notes += (f"the time column says {1e3 * nominal:g} ms a sample; {whose} {1e3 * sample_time:.4g} ms is used",)
    if uneven_steps(samples.time, nominal, samples.run).any():
        notes += (f"the time column is uneven, but {whose} sample time counts rows: nothing was resampled",)
    return Samples(_counted(samples.run) * sample_time, samples.run, samples.channels), sample_time, notes


def _counted(run: np.ndarray) -> np.ndarray:
    """Return the number of each row within its run."""
    first = np.concatenate([[0], np.flatnonzero(np.diff(run)) + 1]) if run.size else np.zeros(0, dtype=np.int64)
    return np.arange(run.size) - np.repeat(first, np.diff(np.append(first, run.size)))


def _values(frame: pd.DataFrame, source: Source, channel: str, layout: Layout) -> Vector:
    total = np.zeros(len(frame))
    for term in source.terms:
        column = _column(frame, term.column, channel)
        missing = may_miss(channel, layout.robot) or clocked(layout, channel)
        cells = numbers(column, str(term.column), missing=missing, nan_words=True)
        if missing:
            _refuse_stand_in(cells, term.column)
        total = total + term.factor * cells
    if total.size and np.isnan(total).all():
        named = ", ".join(f"`{term.column}`" for term in source.terms)
        raise DataError(
            f"column {named} for `{channel}` holds no number in any of its {total.size} rows; is its sensor connected? "
            "Name another column, or leave the channel out of the layout where a recording does not need it."
        )
    return (source.sign * to_si(source.unit)[0]) * total


def _refuse_stand_in(cells: Vector, name: Column) -> None:
    """Raise DataError where a logger wrote a number such as -999 for what was missed."""
    seen = np.unique(cells[np.isfinite(cells)])
    far = seen[int(np.argmax(np.abs(seen)))] if seen.size > _VARIED else 0.0
    if abs(far) < _STAND_IN or far != round(far):
        return
    rows, rest = int((cells == far).sum()), float(np.abs(seen[seen != far]).max())
    if rows > 1 and abs(far) > _FURTHER * rest:
        raise DataError(
            f"column `{name}` holds {far:g} in {rows} rows, {abs(far) / rest:.0f} times as far as all others: is that "
            "a missed sample? Leave these cells empty."
        )


def _column(frame: pd.DataFrame, name: Column, channel: str) -> pd.Series:
    """Return a column by its name, or by its index where names are words."""
    places = [place for place, title in enumerate(frame.columns) if title == name]
    if len(places) > 1:
        raise DataError(f"column `{name}` for `{channel}` stands {len(places)} times in the file; use its index.")
    if not places and isinstance(name, int) and 0 <= name < frame.shape[1]:
        places = [name]
    if not places:
        listed = ", ".join(str(title) for title in frame.columns)
        raise DataError(f"column `{name}` for `{channel}` is not in the file; it has {listed}.")
    return frame.iloc[:, places[0]]
