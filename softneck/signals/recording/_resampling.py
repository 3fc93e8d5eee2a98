"""Resampling of logs with irregular times; gaps split a run and are never bridged."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, Vector, require_positive, require_steps

from ._channels import is_held
from ._recording import Recording

# A step of 1.5 median ones lacks a sample, unless the clock's own steps reach that length without a jump of 1.15 times
# between them; leaving out single clocks chose these (benchmarks/clock_gaps.py). Beyond 4 it is a pause in any clock.
_GAP_STEPS, _LENGTH_JUMP, _PAUSE_STEPS = 1.5, 1.15, 4.0
# With lags of 2 to 4 and as much delay, a shorter piece gives no row to train on.
SHORTEST = 10
# Passband as a share of the new Nyquist frequency; stopband attenuation [dB].
_PASSBAND, _ATTENUATION_DB = 0.7, 60.0
# Instants closer than this many sample times are equal: sums of steps are rounded.
_TIME_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Channels at logged times [s], run by run; all (time,)."""

    time: Vector
    run: np.ndarray
    channels: Mapping[str, Vector]

    def rows(self, keep: np.ndarray) -> Samples:
        """Return the rows that `keep` (time,) marks."""
        return Samples(self.time[keep], self.run[keep], {name: c[keep] for name, c in self.channels.items()})

    def runs(self) -> list[slice]:
        """Return the rows of each run."""
        edges = [0, *(np.flatnonzero(np.diff(self.run)) + 1).tolist(), self.time.size]
        return [slice(start, stop) for start, stop in itertools.pairwise(edges)]


def without_duplicates(samples: Samples, rule: str | None) -> tuple[Samples, tuple[str, ...]]:
    """Keep the `first` or `last` row of each time stamp of a run, by the layout's rule, and return a note."""
    same = (np.diff(samples.time) == 0) & (np.diff(samples.run) == 0)
    if not same.any():
        return samples, ()
    row = int(np.argmax(same)) + 1
    if rule is None:
        raise DataError(
            f"`time` stands still at row {row}: {samples.time[row]:g} s occurs twice ({same.sum()} such row(s)); "
            'fix the log, or write `duplicates = "first"` (or "last") into [time] of the layout to keep one of each.'
        )
    keep = np.append(True, ~same) if rule == "first" else np.append(~same, True)
    note = f"{same.sum()} row(s) left out: their time stamp occurs twice, the first time at row {row}"
    return samples.rows(keep), (note,)


def find_gaps(samples: Samples, jump: float = _LENGTH_JUMP) -> tuple[np.ndarray, float]:
    """Return (time - 1,) whether rows are missing after each row, and the shortest gap [s].

    A late stamp is followed by a short step, so each step is judged together with its shorter neighbour. A clock that
    jitters has long steps of all lengths; only steps beyond a jump in the sorted lengths are gaps.
    """
    step = np.diff(samples.time)
    inside = np.diff(samples.run) == 0
    if not (inside & (step > 0)).any():
        return np.zeros(step.size, dtype=bool), np.inf
    usual = float(np.median(step[inside & (step > 0)]))
    beside = np.concatenate([[np.inf], np.where(inside, step, np.inf), [np.inf]])
    shorter = np.minimum(beside[:-2], beside[2:])
    length = (step + np.where(np.isfinite(shorter), shorter, usual)) / usual - 1.0
    long = np.sort(length[inside & (length > 1.0)])
    gap_lengths = long[1:][long[1:] > jump * long[:-1]] if long.size else long
    gap_lengths = gap_lengths[gap_lengths > _GAP_STEPS]
    if long.size and long[0] > _GAP_STEPS:  # all long steps are gaps
        gap_lengths = long
    bound = min(float(gap_lengths[0]) if gap_lengths.size else np.inf, _PAUSE_STEPS)
    return inside & (length >= bound), bound * usual


def jitter(time: Vector) -> tuple[float, float, float] | None:
    """Return the shortest, longest and median step of a clock that jitters; None if its long steps are gaps.

    A time that goes back starts a new run; rows of one stamp count once.
    """
    time = time[np.append(True, np.diff(time) != 0)]
    run = np.cumsum(np.append(False, np.diff(time) < 0))
    step, inside = np.diff(time), np.diff(run) == 0
    if not inside.any():
        return None
    usual, steps = float(np.median(step[inside])), step[inside & ~find_gaps(Samples(time, run, {}))[0]]
    if not (steps > (_GAP_STEPS + _TIME_TOLERANCE) * usual).any():
        return None
    return float(steps.min()), float(steps.max()), usual


def split_at_gaps(samples: Samples) -> tuple[Samples, tuple[str, ...]]:
    """Start a new run after each gap and return notes; drop pieces shorter than 10 samples."""
    step = np.diff(samples.time)
    inside = np.diff(samples.run) == 0
    gap, bound = find_gaps(samples)
    if not gap.any():
        return samples, ()
    number = np.concatenate([[0], np.cumsum(gap | ~inside)])
    size = np.bincount(number)
    # Only pieces beside a gap are dropped: a short experiment is the user's choice.
    cut = np.zeros(size.size, dtype=bool)
    cut[number[:-1][gap]] = True
    cut[number[1:][gap]] = True
    dropped = cut & (size < SHORTEST)
    row = int(np.argmax(gap)) + 1
    notes = [
        f"{gap.sum()} gap(s) in the time column, the longest {step[gap].max():.4g} s, the first at row {row} "
        f"(t = {samples.time[row]:g} s): each starts a new run"
    ]
    if dropped.any():
        lost = size[dropped].sum()
        notes.append(f"{dropped.sum()} piece(s) between gaps, {lost} rows, dropped: shorter than {SHORTEST} samples")
    kept = Samples(samples.time, number, samples.channels).rows(~dropped[number])
    if kept.time.size == 0:
        raise DataError(
            f"`time` has {gap.sum()} gaps (steps of {bound:.4g} s and more) and no {SHORTEST} samples in a row "
            "between them; is the unit of the time column right, and is it the clock of these samples?"
        )
    return Samples(kept.time, np.unique(kept.run, return_inverse=True)[1], kept.channels), tuple(notes)


def mean_step(samples: Samples) -> float:
    """Return the mean step inside the runs [s] to ten digits, which averages jitter out."""
    step = np.diff(samples.time)[np.diff(samples.run) == 0]
    return float(f"{step.mean():.10g}")


def resampled(recording: Recording, sample_time: float) -> Recording:
    """Return a recording at another sample time [s], run by run; at its own time it is returned unchanged.

    Measured channels are interpolated by a monotone cubic. Before a slower sample time they pass an anti-aliasing
    filter without delay (`low_pass`). Set-points and flags hold their last value.

    Raises:
        DataError: a run is shorter than the new sample time.
    """
    require_positive("sample_time", sample_time, "s")
    if abs(sample_time - recording.sample_time) <= _TIME_TOLERANCE * recording.sample_time:
        return recording
    shortest = min(len(run) for run in recording.runs())
    if (shortest - 1) * recording.sample_time < sample_time:
        raise DataError(
            f"a run of {shortest} rows at {recording.sample_time:g} s has no two samples {sample_time:g} s apart."
        )
    samples = Samples(recording.time, recording.run, recording.channels)
    ratio = sample_time / recording.sample_time
    if ratio > 1.0:
        samples = _without_aliases(samples, ratio)
    even, _ = resample(samples, sample_time)
    return Recording(even.time, sample_time, even.channels, even.run, recording.robot)


def _without_aliases(samples: Samples, ratio: float) -> Samples:
    """Low-pass the measured channels of each run for a sample time `ratio` times as long."""
    channels = dict(samples.channels)
    for name, values in samples.channels.items():
        if not is_held(name):
            channels[name] = np.concatenate([low_pass(values[rows], ratio) for rows in samples.runs()])
    return Samples(samples.time, samples.run, channels)


def low_pass(values: Vector, ratio: float) -> Vector:
    """Low-pass values (time,) for a sample time `ratio` times as long, without delay.

    The filter is a sinc in a Kaiser window of 60 dB (Kaiser 1974); it passes 0.7 of the new Nyquist frequency and stops
    at it. Both ends are continued by point reflection, which keeps straight lines straight. Missed samples are bridged
    for the filter and stay missed.
    """
    from scipy.signal import firwin, kaiserord

    present = np.isfinite(values)
    if values.size < 3 or present.sum() < 2:
        return values
    taps, beta = kaiserord(_ATTENUATION_DB, (1.0 - _PASSBAND) / ratio)
    # A run shorter than the window gets a shorter window, whose edge is less steep.
    half = min(taps // 2, values.size - 1)
    window: Any = ("kaiser", beta)
    weights = np.asarray(firwin(2 * half + 1, 0.5 * (1.0 + _PASSBAND) / ratio, window=window), dtype=np.float64)
    whole = np.interp(np.arange(values.size), np.flatnonzero(present), values[present])
    filtered = np.convolve(np.pad(whole, half, mode="reflect", reflect_type="odd"), weights, mode="valid")
    return np.where(present, filtered, np.nan)


def resample(samples: Samples, sample_time: float) -> tuple[Samples, float]:
    """Return the samples at multiples of `sample_time` [s] from the start of each run, and the largest shift [s].

    Measured channels are interpolated by PCHIP (Fritsch and Carlson 1980) through the samples present; an instant next
    to a missed sample is missed. Set-points and flags hold their last value. The shift is the distance from an instant
    to the nearest logged sample.
    """
    parts: list[Samples] = []
    shift = 0.0
    for rows in samples.runs():
        t = samples.time[rows]
        span = float(t[-1] - t[0])
        require_steps("time", span, sample_time, 1 + len(samples.channels))
        count = int(np.floor(span / sample_time + _TIME_TOLERANCE)) + 1
        grid = t[0] + sample_time * np.arange(count)
        before = np.clip(np.searchsorted(t, grid + _TIME_TOLERANCE * sample_time, side="right") - 1, 0, t.size - 1)
        after = np.minimum(before + (np.abs(grid - t[before]) > _TIME_TOLERANCE * sample_time), t.size - 1)
        shift = max(shift, float(np.minimum(np.abs(grid - t[before]), np.abs(t[after] - grid)).max()))
        channels = {
            name: c[rows][before] if is_held(name) else _interpolate(t, c[rows], grid, before, after)
            for name, c in samples.channels.items()
        }
        parts.append(Samples(grid, np.full(count, samples.run[rows.start]), channels))
    names = tuple(samples.channels)
    joined = {name: np.concatenate([part.channels[name] for part in parts]) for name in names}
    time, run = (np.concatenate([getattr(part, what) for part in parts]) for what in ("time", "run"))
    return Samples(time, run, joined), shift


def _interpolate(t: Vector, x: Vector, grid: Vector, before: np.ndarray, after: np.ndarray) -> Vector:
    """Interpolate x (time,) at `grid` (instants,) between its samples `before` and `after`."""
    from scipy.interpolate import PchipInterpolator

    present = np.isfinite(x)
    missed = ~(present[before] & present[after])
    values = x[before]
    # Fewer than two points cannot be interpolated.
    if present.sum() > 1:
        try:
            values = PchipInterpolator(t[present], x[present])(grid)
        except ValueError as error:  # damaged numbers have slopes that are not finite
            largest = float(np.abs(x[present]).max())
            raise DataError(
                f"a channel reaches {largest:.3g} within {np.ptp(t):.3g} s and cannot be resampled; is the log damaged?"
            ) from error
    values = np.where(before == after, x[before], values)
    return np.where(missed, np.nan, values)
