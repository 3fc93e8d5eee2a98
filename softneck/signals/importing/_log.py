"""Foreign logs become recordings through a layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, FileFormatError, SoftneckError, Vector, to_si
from softneck.robot import Robot

from ..recording._channels import MOTOR_POSITIONS, MOTOR_TURNS, SET_POINTS, may_miss
from ..recording._files import integers, numbers, read_table
from ..recording._recording import Recording
from ..recording._resampling import Samples, mean_step, resample, split_at_gaps, without_duplicates
from ..recording._times import check_rising, median_step, uneven
from ._layout import Column, Layout, Source
from ._mat import read_mat
from ._sample_time import estimate_sample_time
from ._tilt import pitch_roll

if TYPE_CHECKING:
    import pandas as pd

# Part of the samples of a channel that may be anything.
_GLITCHES = 0.01


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
    """
    source = Path(path)
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
    """Return a log's table by its ending: `.parquet`, `.mat`, or else text.

    Raises:
        FileFormatError: no such file or no table.
        DataError: a MAT file without the variable.
    """
    suffix = source.suffix.lower()
    if suffix == ".mat":
        if not source.is_file():
            raise FileFormatError(f"{source}: no such file.")
        return read_mat(source, layout.variable, tuple(str(c) for c in _columns(layout)))
    if layout.variable is not None:
        raise DataError(f"{source}: the layout's `variable` is for a `.mat` file.")
    kind = ".parquet" if suffix == ".parquet" else ".csv"
    frame = read_table(source, kind, layout.form)
    frame.columns = [name.strip() if isinstance(name, str) else name for name in frame.columns]
    return frame


def _columns(layout: Layout) -> tuple[Column, ...]:
    """Return all columns that a layout names."""
    sources = [*layout.channels.values(), layout.inclination, layout.orientation, layout.time]
    named = [term.column for source in sources if source is not None for term in source.terms]
    return (*named, layout.run) if layout.run is not None else tuple(named)


def _imported(frame: pd.DataFrame, layout: Layout) -> ImportResult:
    channels = {name: _values(frame, source, name, layout.robot) for name, source in layout.channels.items()}
    if layout.inclination is not None and layout.orientation is not None:
        i = _values(frame, layout.inclination, "pitch", layout.robot)
        o = _values(frame, layout.orientation, "pitch", layout.robot)
        channels["pitch"], channels["roll"] = pitch_roll(i, o)
    samples, sample_time, notes = _clocked(frame, layout, channels)
    recording = Recording(samples.time, sample_time, samples.channels, samples.run, layout.robot)
    if layout.robot.is_neck:
        _refuse_turns(layout, recording.channels)
    if not np.ptp(recording.set_points, axis=0).any():
        notes += ("warning: no set-point ever changes: nothing can be identified from this log",)
    return ImportResult(recording, notes)


def _refuse_turns(layout: Layout, channels: Mapping[str, Vector]) -> None:
    """Raise DataError where motors turn further than they can for more than some glitches of an encoder."""
    for name in (*SET_POINTS, *MOTOR_POSITIONS):
        reached = np.abs(channels.get(name, np.zeros(1)))
        if (reached > MOTOR_TURNS).mean() > _GLITCHES:
            reach = np.nanmax(reached)
            hint = 'is it in degrees (`unit = "deg"`)?' if layout.channels[name].unit == "rad" else "is `factor` right?"
            raise DataError(
                f"`{name}` reaches {reach:.4g} rad, which is {reach / (2.0 * np.pi):.0f} turns; the motors' range is "
                f"6 rad. Mend its line in the layout: {hint}"
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
        return Samples(_counted(run) * sample_time, run, channels), sample_time, notes
    time = _values(frame, layout.time, "time", layout.robot)
    notes = ()
    if layout.new_run_at_restart and run.size:
        run[1:] = np.cumsum((np.diff(time) < 0) | (np.diff(run) != 0))
        run[0] = 0
        notes = (f"{run[-1] + 1} run(s), by restarts of the time column",)
    check_rising(time, run, may_stand=True)
    samples, left_out = without_duplicates(Samples(time, run, channels), layout.duplicates)
    samples, gaps = split_at_gaps(samples)
    nominal = median_step(samples.time, samples.run)
    sample_time, remarks = _sample_time(layout, samples.channels, samples.run, nominal)
    notes += left_out + gaps + remarks
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
    if not uneven(samples.time, nominal, samples.run).any():
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
    if uneven(samples.time, nominal, samples.run).any():
        notes += (f"the time column is uneven, but {whose} sample time counts rows: nothing was resampled",)
    return Samples(_counted(samples.run) * sample_time, samples.run, samples.channels), sample_time, notes


def _counted(run: np.ndarray) -> np.ndarray:
    """Return the number of each row within its run."""
    first = np.concatenate([[0], np.flatnonzero(np.diff(run)) + 1]) if run.size else np.zeros(0, dtype=np.int64)
    return np.arange(run.size) - np.repeat(first, np.diff(np.append(first, run.size)))


def _values(frame: pd.DataFrame, source: Source, channel: str, robot: Robot) -> Vector:
    total = np.zeros(len(frame))
    for term in source.terms:
        column = _column(frame, term.column, channel)
        total = total + term.factor * numbers(
            column, str(term.column), missing=may_miss(channel, robot), nan_words=True
        )
    if total.size and np.isnan(total).all():
        named = ", ".join(f"`{term.column}`" for term in source.terms)
        raise DataError(
            f"column {named} for `{channel}` holds no number in any of its {total.size} rows; is its sensor connected? "
            "Name another column, or leave the channel out of the layout where a recording does not need it."
        )
    return (source.sign * to_si(source.unit)[0]) * total


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
