"""Times of a log: seconds or dates, rows of several clocks, dropped rows, and rates integrated to positions."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, Matrix, Vector, to_si

from ..recording._channels import MOTOR_POSITIONS, MOTOR_VELOCITIES, is_held, may_miss
from ..recording._files import numbers
from ..recording._resampling import Samples, find_gaps
from ._layout import Layout, Source
from .formats._text import DATE, EPOCH, seconds

if TYPE_CHECKING:
    import pandas as pd

    from softneck.robot import Robot

# Differences over this many samples, averaged over as many, suppress quantisation, the drive's noise and the difference
# scheme of the rates (forward, backward or central), and keep every move.
_WINDOW_ROWS = 20
# Smallest correlation of a position and its rate; below it they belong to different motions or have a wrong sign.
_MIN_CORRELATION = 0.9
# Estimates of one log differ by a few % between motors; this is the tolerance for a nominal time.
_TOLERANCE_RATIO = 0.03


@dataclass(frozen=True, slots=True)
class SampleTime:
    """An estimated sample time [s]: the median over so many `motors`, and the smallest and largest."""

    value: float
    lowest: float
    highest: float
    motors: int

    def contradicts(self, nominal: float) -> bool:
        """Return whether `nominal` [s] lies outside the motors' values and their usual scatter."""
        return not self.lowest * (1 - _TOLERANCE_RATIO) <= nominal <= self.highest * (1 + _TOLERANCE_RATIO)

    def __str__(self) -> str:
        return f"{1e3 * self.value:.3g} ms ({1e3 * self.lowest:.3g} to {1e3 * self.highest:.3g}, {self.motors} motors)"


def estimate_sample_time(channels: Mapping[str, Vector], run: np.ndarray) -> SampleTime:
    """Return the period T for which `x(k+n) - x(k) = T sum v` fits best within each run, both averaged over n rows.

    Rates that are differences lack motion faster than their step, so both sides are averaged. Both carry noise, so T is
    the ratio of their lengths (the geometric mean of the two regressions).
    """
    periods = []
    for position, speed in zip(MOTOR_POSITIONS, MOTOR_VELOCITIES, strict=True):
        x, v = channels.get(position), channels.get(speed)
        if x is not None and v is not None:
            period, correlation = velocity_period(x, v, run)
            if correlation > _MIN_CORRELATION:
                periods.append(period)
    if not periods:
        raise DataError(
            "the sample time cannot be estimated: no motor has a position and a velocity that agree; "
            "give `sample_time_s` as a number."
        )
    return SampleTime(float(np.median(periods)), min(periods), max(periods), len(periods))


def velocity_period(x: Vector, v: Vector, run: np.ndarray) -> tuple[float, float]:
    """Return the period [s] at which v is the rate of x, and their correlation; 0, 0 without motion."""
    moved, sums = [], []
    for border in np.split(np.arange(x.size), np.flatnonzero(np.diff(run)) + 1):
        if border.size > 2 * _WINDOW_ROWS:
            position, velocity = x[border], v[border]
            total = np.concatenate([[0.0], np.cumsum((velocity[1:] + velocity[:-1]) / 2)])
            moved.append(_mean_move(position))
            sums.append(_mean_move(total))
    if not moved:
        return 0.0, 0.0
    a, b = np.concatenate(moved), np.concatenate(sums)
    good = np.isfinite(a) & np.isfinite(b)
    aa, bb, ab = float(a[good] @ a[good]), float(b[good] @ b[good]), float(a[good] @ b[good])
    return (0.0, 0.0) if aa * bb == 0 else (float(np.sqrt(aa / bb)), ab / float(np.sqrt(aa * bb)))


def _mean_move(x: Vector) -> Vector:
    """Return the differences over a window, averaged over the next one."""
    return np.convolve(x[_WINDOW_ROWS:] - x[:-_WINDOW_ROWS], np.full(_WINDOW_ROWS, 1.0 / _WINDOW_ROWS), "valid")


# Values between two messages further apart than this many median steps are missed, not interpolated.
_MAX_MESSAGE_GAP = 2.5
# Fill gaps of up to 3 rows (60 ms at 20 ms, less than the dead time of a neck), if there are at least 10, nearly all
# gaps of the log are as short, and pieces between them last at most 3 s at 20 ms: their hold-out would be a second.
_MAX_GAP_ROWS, _MIN_GAPS, _MIN_GAP_SHARE, _MAX_PIECE_ROWS, _WHOLE_TOLERANCE = 3, 10, 0.9, 150, 0.2


def read_times(columns: Sequence[pd.Series], source: Source) -> tuple[Vector, tuple[str, ...]]:
    """Return (time,) [s] of a time's source, and a note; times since 1970 count from the first row."""
    if source.unit == DATE:
        column, name = columns[0], str(source.terms[0].column)
        return seconds(column, name), (f"time counts from the first date, {column.iloc[0]}",) if len(column) else ()
    total = np.zeros(len(columns[0]))
    factor, start = to_si(source.unit)[0], 0.0
    for column, term in zip(columns, source.terms, strict=True):
        values = numbers(column, str(term.column), missing=False)
        scale = source.sign * factor * term.factor
        if values.size and abs(scale * values[0]) > EPOCH:
            # Subtract before scaling, so that whole numbers of nanoseconds stay exact.
            start = scale * float(values[0])
            values = values - values[0]
        total = total + scale * values
    return total, (f"time counts from {_moment(start)}",) if start else ()


def _moment(since_1970: float) -> str:
    try:
        return datetime.datetime.fromtimestamp(since_1970, datetime.UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (ValueError, OverflowError, OSError):
        return f"{since_1970:.10g} s"


def merge_clocks(samples: Samples, outputs: Sequence[str]) -> tuple[Samples, str]:
    """Return one row for each output sample of rows that are messages of several clocks, and a note.

    Set-points and flags hold their last value; other channels are interpolated linearly, but not across long gaps. Rows
    before the first set-point are dropped.
    """
    present = {name: np.isfinite(values) for name, values in samples.channels.items()}
    empty = [name for name, there in present.items() if not there.any()]
    if empty:
        raise DataError(f"`{empty[0]}` holds no number in any row.")
    base = min((name for name in outputs if name in present), key=lambda name: int(present[name].sum()), default=None)
    if base is None:
        raise DataError(f"`merge` needs the columns of {', '.join(outputs)}.")
    keep = present[base].copy()
    found: dict[str, Vector] = {}
    for name, values in samples.channels.items():
        found[name] = np.full(values.size, np.nan)
        for rows in samples.runs():
            part = last_values(values[rows]) if is_held(name) else _between(samples.time[rows], values[rows])
            found[name][rows] = part
        if is_held(name):
            keep &= np.isfinite(found[name])
    if not keep.any():
        raise DataError("no row has both an output and all set-points before it.")
    note = f"merged rows of several clocks: {keep.sum()} of {keep.size} rows, those of `{base}`; set-points hold"
    return Samples(samples.time, samples.run, found).rows(keep), note


def last_values(values: Vector) -> Vector:
    """Hold each value until the next one; NaN before the first."""
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(values.size), -1))
    return np.where(last >= 0, values[last], np.nan)


def _between(time: Vector, values: Vector) -> Vector:
    """Interpolate values linearly at all times, except across long gaps."""
    present = np.isfinite(values)
    if present.sum() < 2:
        return values
    t, x = time[present], values[present]
    step = np.diff(t)
    usual = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    after = np.clip(np.searchsorted(t, time), 1, t.size - 1)
    far = (t[after] - t[after - 1] > _MAX_MESSAGE_GAP * usual) | (time < t[0]) | (time > t[-1])
    return np.where(present, values, np.where(far, np.nan, np.interp(time, t, x)))


def fill_gaps(samples: Samples, robot: Robot, *, always: bool = False) -> tuple[Samples, tuple[str, ...]]:
    """Insert rows that a logger dropped repeatedly as missed samples, and return a note.

    A gap splits a run, since its set-points are unknown. If short gaps are so frequent that the pieces would be too
    short to judge a model, set-points and flags hold their last value in them instead. `always` fills all short gaps
    (benchmarks/clock_gaps.py --models).
    """
    step, inside = np.diff(samples.time), np.diff(samples.run) == 0
    steps = step[inside & (step > 0)]
    if not steps.size:
        return samples, ()
    usual = step / float(np.median(steps))
    gap, lost = find_gaps(samples)[0], np.rint(np.clip(usual, 1.0, 1e3)).astype(np.int64) - 1
    # A clock that jitters loses no rows: its long steps are no whole multiples of the median.
    few = gap & (lost >= 1) & (lost <= _MAX_GAP_ROWS) & (np.abs(usual - lost - 1) < _WHOLE_TOLERANCE)
    count = few.sum()
    seldom = count < max(_MIN_GAPS, _MIN_GAP_SHARE * gap.sum()) or samples.time.size > _MAX_PIECE_ROWS * count
    if not few.any() or (seldom and not always):
        return samples, ()
    before = np.repeat(np.flatnonzero(few), lost[few])
    part = np.concatenate([np.arange(1, count + 1) / (count + 1.0) for count in lost[few]])
    channels = {}
    for name, values in samples.channels.items():
        missed = values[before] + part * (values[before + 1] - values[before])
        if is_held(name):
            missed = values[before]
        elif may_miss(name, robot):
            missed = np.full(before.size, np.nan)
        channels[name] = np.insert(values, before + 1, missed)
    time = np.insert(samples.time, before + 1, samples.time[before] + part * step[before])
    note = (
        f"{before.size} row(s) that were not logged, in {few.sum()} gaps of {_MAX_GAP_ROWS} or fewer, are missed "
        "samples, in which set-points hold"
    )
    return Samples(time, np.insert(samples.run, before + 1, samples.run[before]), channels), (note,)


def integrate_rates(samples: Samples, sources: Mapping[str, Source]) -> tuple[Samples, tuple[str, ...]]:
    """Integrate the channels whose source is a rate, and return a note.

    Rates are integrated by trapezoids at the logged times, from 0 in each run; missed samples are interpolated.
    """
    names = [name for name, source in sources.items() if source.integrate and name in samples.channels]
    if not names:
        return samples, ()
    channels = dict(samples.channels)
    for name in names:
        channels[name] = np.zeros(samples.time.size)
        for rows in samples.runs():
            t, v = samples.time[rows], samples.channels[name][rows]
            present = np.isfinite(v)
            v = np.interp(t, t[present], v[present]) if present.any() else np.zeros(v.size)
            channels[name][rows] = np.concatenate([[0.0], np.cumsum(np.diff(t) * (v[1:] + v[:-1]) / 2.0)])
    note = f"{', '.join(names)}: integrated from rates, from 0 at the start of each run; drift remains"
    return Samples(samples.time, samples.run, channels), (note,)


def may_be_empty(layout: Layout, name: str) -> bool:
    """Return whether a channel may have empty cells: rows are messages of several clocks, or it is integrated."""
    source = layout.channels.get(name)
    return layout.merge or (source is not None and source.integrate)


def pitch_roll(inclination: Vector, orientation: Vector) -> tuple[Vector, Vector]:
    """Return pitch and roll [rad] of a tilt by `inclination` [rad] towards `orientation` [rad].

    Motor 1 sits at orientation 90 deg (README of the recordings):
    `pitch = atan2(sin i sin o, cos i)`, `roll = -atan2(sin i cos o, cos i)`.
    """
    i, o = np.asarray(inclination), np.asarray(orientation)
    pitch = np.arctan2(np.sin(i) * np.sin(o), np.cos(i))
    roll = -np.arctan2(np.sin(i) * np.cos(o), np.cos(i))
    return pitch, roll


def axis_rotations(quaternion: Matrix) -> dict[str, Vector]:
    """Return the rotations [rad] about the sensor's axes `x`, `-x`, `y`, `-y` from (time, 4) w, x, y, z.

    These are roll and pitch of yaw-pitch-roll Euler angles (z, y', x''), as in ROS and aviation:
    `x = atan2(2 (w x + y z), 1 - 2 (x^2 + y^2))`, `y = asin(2 (w y - z x))` (Diebel 2006, sec. 8.11). A row of zeros or
    without numbers is a missed sample.
    """
    length = np.sqrt((quaternion * quaternion).sum(axis=1))
    sound = np.abs(length - 1.0) < 0.1
    if (~sound & np.isfinite(length) & (length > 0.0)).mean() > 0.5:
        middle = float(np.median(length[np.isfinite(length)]))
        raise DataError(f"the columns of [quaternion] have length {middle:.3g}, not 1: they are no unit quaternion.")
    w, x, y, z = (quaternion / np.where(sound, length, np.nan)[:, None]).T
    about_x = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    about_y = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return {"x": about_x, "-x": -about_x, "y": about_y, "-y": -about_y}
