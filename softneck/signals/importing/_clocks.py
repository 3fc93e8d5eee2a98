"""Times of a log: seconds or dates, sums of columns, rows of several clocks, and rates summed up to positions."""

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
from .formats._dates import DATE, EPOCH, seconds

if TYPE_CHECKING:
    import pandas as pd

    from softneck.robot import Robot

# Differences over this many samples, averaged over as many, drown quantisation, the drive's noise and the rule by which
# rates were made of positions (a difference to the next row, the last, or both), and still see every move.
_WINDOW = 20
# Below it position and velocity do not tell of the same motion (another motor, a command, a wrong sign).
_AGREE = 0.9
# Estimates of one log differ by a few % between motors; a nominal time further off is wrong.
_FITS = 0.03


@dataclass(frozen=True, slots=True)
class SampleTime:
    """An estimate [s]: the median over motors, and the smallest and largest of them."""

    value: float
    lowest: float
    highest: float
    motors: int

    def contradicts(self, nominal: float) -> bool:
        """Return whether `nominal` [s] lies outside the motors' values and their usual scatter."""
        return not self.lowest * (1 - _FITS) <= nominal <= self.highest * (1 + _FITS)

    def __str__(self) -> str:
        return f"{1e3 * self.value:.3g} ms ({1e3 * self.lowest:.3g} to {1e3 * self.highest:.3g}, {self.motors} motors)"


def estimate_sample_time(channels: Mapping[str, Vector], run: np.ndarray) -> SampleTime:
    """Return the period T for which `x(k+n) - x(k) = T sum v` holds best within each run, both averaged over n rows.

    Rates that are differences lack what is faster than their step, so neither side may hold it. Both sides carry
    noise, so T is the ratio of their lengths (the geometric mean of the two regressions).

    Args:
        channels: with motor_position_j [rad] and motor_velocity_j [rad/s], each (time,).
        run: (time,) numbers of the runs.
    """
    periods = []
    for position, speed in zip(MOTOR_POSITIONS, MOTOR_VELOCITIES, strict=True):
        x, v = channels.get(position), channels.get(speed)
        if x is not None and v is not None:
            period, correlation = velocity_period(x, v, run)
            if correlation > _AGREE:
                periods.append(period)
    if not periods:
        raise DataError(
            "the sample time cannot be estimated: no motor has a position and a velocity that agree; "
            "give `sample_time_s` as a number."
        )
    return SampleTime(float(np.median(periods)), min(periods), max(periods), len(periods))


def velocity_period(x: Vector, v: Vector, run: np.ndarray) -> tuple[float, float]:
    """Return the period [s] at which v is the rate of x, and the correlation of both motions; 0, 0 without motion."""
    moved, sums = [], []
    for border in np.split(np.arange(x.size), np.flatnonzero(np.diff(run)) + 1):
        if border.size > 2 * _WINDOW:
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
    return np.convolve(x[_WINDOW:] - x[:-_WINDOW], np.full(_WINDOW, 1.0 / _WINDOW), "valid")


# Measured values between two messages further apart than this many usual ones are missed, not interpolated.
_FAR = 2.5
# Gaps of up to 3 rows (60 ms at 20 ms, less than the dead time of a neck), 10 of them at least, nearly all gaps of the
# log, and pieces of 3 s at 20 ms or less on average: a hold-out of them is a second.
_FEW, _OFTEN, _NEARLY_ALL, _PIECE, _WHOLE = 3, 10, 0.9, 150, 0.2


def time_of(columns: Sequence[pd.Series], source: Source) -> tuple[Vector, tuple[str, ...]]:
    """Return (time,) [s] of a time's source, and what was done; times since 1970 count from the first."""
    if source.unit == DATE:
        column, name = columns[0], str(source.terms[0].column)
        return seconds(column, name), (f"time counts from the first date, {column.iloc[0]}",) if len(column) else ()
    total = np.zeros(len(columns[0]))
    factor, start = to_si(source.unit)[0], 0.0
    for column, term in zip(columns, source.terms, strict=True):
        values = numbers(column, str(term.column), missing=False)
        scale = source.sign * factor * term.factor
        if values.size and abs(scale * values[0]) > EPOCH:
            # Subtracted before it is scaled: whole numbers of nanoseconds lose nothing.
            start = scale * float(values[0])
            values = values - values[0]
        total = total + scale * values
    return total, (f"time counts from {_moment(start)}",) if start else ()


def _moment(since_1970: float) -> str:
    try:
        return datetime.datetime.fromtimestamp(since_1970, datetime.UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (ValueError, OverflowError, OSError):
        return f"{since_1970:.10g} s"


def merged(samples: Samples, outputs: Sequence[str]) -> tuple[Samples, str]:
    """Return rows where an output was measured, of rows that are messages of several clocks, and a note.

    Set-points and flags keep the last value before; other channels are interpolated linearly between their neighbours,
    and are missed where those are far apart. Rows before the first set-point are left out.
    """
    told = {name: np.isfinite(values) for name, values in samples.channels.items()}
    silent = [name for name, there in told.items() if not there.any()]
    if silent:
        raise DataError(f"`{silent[0]}` holds no number in any row.")
    base = min((name for name in outputs if name in told), key=lambda name: int(told[name].sum()), default=None)
    if base is None:
        raise DataError(f"`merge` needs the columns of {', '.join(outputs)}.")
    keep = told[base].copy()
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
    """Return each value until the next one; NaN before the first."""
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(values.size), -1))
    return np.where(last >= 0, values[last], np.nan)


def _between(time: Vector, values: Vector) -> Vector:
    """Return values at all times, on straight lines between those that are there."""
    seen = np.isfinite(values)
    if seen.sum() < 2:
        return values
    t, x = time[seen], values[seen]
    step = np.diff(t)
    usual = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    after = np.clip(np.searchsorted(t, time), 1, t.size - 1)
    far = (t[after] - t[after - 1] > _FAR * usual) | (time < t[0]) | (time > t[-1])
    return np.where(seen, values, np.where(far, np.nan, np.interp(time, t, x)))


def filled(samples: Samples, robot: Robot, *, always: bool = False) -> tuple[Samples, tuple[str, ...]]:
    """Return the samples with rows that a logger dropped again and again as missed samples, and a note.

    A gap splits a run, since nobody knows what was asked in it. Where a row or a few are lost so often that the pieces
    would be too short to judge a model by, set-points and flags hold their last value there instead; `always`: wherever
    they are lost (benchmarks/clock_gaps.py --models).
    """
    step, inside = np.diff(samples.time), np.diff(samples.run) == 0
    steps = step[inside & (step > 0)]
    if not steps.size:
        return samples, ()
    usual = step / float(np.median(steps))
    gap, lost = find_gaps(samples)[0], np.rint(np.clip(usual, 1.0, 1e3)).astype(np.int64) - 1
    # A clock that jitters loses nothing: its long steps are no whole numbers of usual ones.
    few = gap & (lost >= 1) & (lost <= _FEW) & (np.abs(usual - lost - 1) < _WHOLE)
    seldom = few.sum() < _OFTEN or few.sum() < _NEARLY_ALL * gap.sum() or samples.time.size > _PIECE * few.sum()
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
        f"{before.size} row(s) that were not logged, in {few.sum()} gaps of {_FEW} or fewer, are missed samples, in "
        "which set-points hold"
    )
    return Samples(time, np.insert(samples.run, before + 1, samples.run[before]), channels), (note,)


def integrated(samples: Samples, sources: Mapping[str, Source]) -> tuple[Samples, tuple[str, ...]]:
    """Return the samples with the integrals over time of the channels whose source says so, and a note.

    Rates are summed by trapezoids at the times as logged, from 0 in each run; a missed one lies between its neighbours.
    """
    names = [name for name, source in sources.items() if source.integrate and name in samples.channels]
    if not names:
        return samples, ()
    channels = dict(samples.channels)
    for name in names:
        channels[name] = np.zeros(samples.time.size)
        for rows in samples.runs():
            t, v = samples.time[rows], samples.channels[name][rows]
            seen = np.isfinite(v)
            v = np.interp(t, t[seen], v[seen]) if seen.any() else np.zeros(v.size)
            channels[name][rows] = np.concatenate([[0.0], np.cumsum(np.diff(t) * (v[1:] + v[:-1]) / 2.0)])
    note = f"{', '.join(names)}: summed up from rates, from 0 at the start of each run; what drifts is not seen"
    return Samples(samples.time, samples.run, channels), (note,)


def clocked(layout: Layout, name: str) -> bool:
    """Return whether a channel may lack numbers where rows are messages of several clocks, or rates that are summed."""
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


def turns(quaternion: Matrix) -> dict[str, Vector]:
    """Return the turns [rad] about the axes `x` and `y` of a sensor, and `-x`, `-y`, of (time, 4) w, x, y, z.

    They are the first two of yaw, pitch and roll in this order (z, y', x''), which ROS and aviation use:
    `x = atan2(2 (w x + y z), 1 - 2 (x^2 + y^2))`, `y = asin(2 (w y - z x))` (Diebel 2006, sec. 8.11). A row without
    numbers is a missed sample, and so is one of zeros.
    """
    length = np.sqrt((quaternion * quaternion).sum(axis=1))
    sound = np.abs(length - 1.0) < 0.1
    if (~sound & np.isfinite(length) & (length > 0.0)).mean() > 0.5:
        middle = float(np.median(length[np.isfinite(length)]))
        raise DataError(f"the columns of [quaternion] have length {middle:.3g} and not 1: they are something else.")
    w, x, y, z = (quaternion / np.where(sound, length, np.nan)[:, None]).T
    about_x = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    about_y = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return {"x": about_x, "-x": -about_x, "y": about_y, "-y": -about_y}
