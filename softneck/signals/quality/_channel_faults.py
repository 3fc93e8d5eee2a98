"""Faults of one channel: missed, frozen and clipped samples, spikes, coarse steps, noise."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from softneck.core import Vector, to_si

from ..recording._channels import file_unit
from ..recording._recording import Recording
from ..recording._wraps import count_wraps

# A deployment calls 20 identical samples frozen as well (hardware facts, table of faults).
FROZEN_SAMPLES = 20
# Fewer equal values at the edge of a range occur by chance or at a slow turn.
CLIPPED_SAMPLES = 3
# A channel that repeats its last value in a smaller share of samples has no long repeats by chance.
_MAX_CHANCE_REPEATS = 0.05
# Motion of an input, in its standard deviations: while a channel was frozen; for each sample of a flat top; and in all
# (a drive's friction hides smaller motions of a set-point, as neck_openloop shows).
_MIN_MOTION, _MIN_MOTION_PER_SAMPLE, _MIN_MOTION_AT_TOP = 0.25, 0.01, 0.05
# The output lags by 0.08 s of dead time and starts slowly: the input's last 0.2 s do not show in it yet.
_DEAD_SAMPLES = 10
# Width of the median filter that removes spikes of one or two samples and keeps steps and ramps.
_SPIKE_WINDOW = 5
# In standard deviations of the filter's residual; Gaussian noise reaches 6 once in 5e8 samples.
_SPIKE_LIMIT = 9.0
# Share of the channel's range below which a spike is ignored.
_SPIKE_FLOOR = 0.02
_MAD_TO_STD = 1.4826
# Variance of the fourth difference of white noise: 1 + 16 + 36 + 16 + 1.
_FOURTH_DIFFERENCE_VARIANCE = 70.0
# Noise of a channel without noise, relative to its range: a sensor of 1,000 levels.
_LEAST_NOISE_RATIO = 1e-3
# Commands may hold or repeat a value without a fault of a sensor.
_COMMAND_CHANNELS = re.compile(
    r"motor_setpoint_|.*_(setpoint|reference)$|payload|push_|base_tilt_|healthy|enabled|measurement_valid"
)


@dataclass(frozen=True, slots=True)
class Segment:
    """Rows start to stop (not included) of one run, from `time` [s] on."""

    start: int
    stop: int
    time: float
    run: int

    @property
    def rows(self) -> int:
        """Return the number of rows."""
        return self.stop - self.start

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON values."""
        return {"start_row": self.start, "rows": self.rows, "time_s": self.time, "run": self.run}


@dataclass(frozen=True, slots=True)
class ChannelQuality:
    """One channel; values in SI.

    Attributes:
        rows: number of samples, missed ones included.
        lowest, highest: range of the finite samples; NaN without any.
        missed: segments without a sample.
        frozen: segments of at least 20 equal values while the input moves.
        clipped: flat tops at the channel's highest or lowest value.
        outliers: spikes of one or two samples.
        wraps: jumps by a full turn at the edge of an angle's range.
        quantum: step between levels; None without one.
        repeats: share of samples that equal the one before.
        noise: standard deviation of white noise, from fourth differences; NaN for a short channel.
    """

    name: str
    unit: str
    rows: int
    lowest: float
    highest: float
    missed: tuple[Segment, ...]
    frozen: tuple[Segment, ...]
    clipped: tuple[Segment, ...]
    outliers: tuple[Segment, ...]
    wraps: int
    quantum: float | None
    repeats: float
    noise: float

    @property
    def missed_rows(self) -> int:
        """Return the number of missing samples."""
        return count_rows(self.missed)

    @property
    def levels(self) -> float | None:
        """Return the number of quanta in the range."""
        return None if self.quantum is None else (self.highest - self.lowest) / self.quantum

    @property
    def is_command(self) -> bool:
        """Return whether the channel is a command and not a measurement."""
        return is_command(self.name)

    def in_file_unit(self, value: float) -> float:
        """Return an SI value in the channel's file unit."""
        return value / to_si(self.unit)[0]

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON values in file units, with at most 20 segments of each fault."""
        quantum = None if self.quantum is None else self.in_file_unit(self.quantum)
        faults = {"missed": self.missed, "frozen": self.frozen, "clipped": self.clipped, "outliers": self.outliers}
        return {
            "unit": self.unit,
            "lowest": self.in_file_unit(self.lowest),
            "highest": self.in_file_unit(self.highest),
            "quantum": quantum,
            "levels": self.levels,
            "repeats": self.repeats,
            "wraps": self.wraps,
            "noise_std": self.in_file_unit(self.noise),
            **{f"{sort}_rows": count_rows(found) for sort, found in faults.items()},
            **{sort: [segment.as_dict() for segment in found[:20]] for sort, found in faults.items()},
        }


def check_channel(recording: Recording, name: str) -> ChannelQuality:
    """Return the faults of channel `name`; no check crosses the border of two runs."""
    y, run, unit = recording.channels[name], recording.run, file_unit(name, recording.robot)
    good = np.isfinite(y)
    missed = _segments_of(~good, recording)
    if not good.any():
        nan = float("nan")
        return ChannelQuality(name, unit, y.size, nan, nan, missed, (), (), (), 0, None, 0.0, nan)
    equal = np.concatenate([[False], (y[1:] == y[:-1]) & (run[1:] == run[:-1])])
    repeats = float(equal[good].mean())
    quantum, (noise, noisy) = _quantum(y[good]), _noise(y, run)
    frozen = clipped = outliers = ()
    wraps = 0
    if is_command(name):
        quantum = None
    elif y[good].min() < y[good].max():
        flats = _find_flats(equal)
        long = flats[flats[:, 1] - flats[:, 0] >= FROZEN_SAMPLES]
        # The chance of repeated values is judged outside frozen segments and the edges of the range.
        outside = equal & (y != y[good].max()) & (y != y[good].min())
        for start, stop in long:
            outside[start:stop] = False
        # A measured output always has noise; a drive, a tension or a length may rest.
        noisy = noisy and noise > 2.0 * (quantum or 0.0) and name.startswith(recording.robot.outputs.names)
        chance = bool(outside.mean() < _MAX_CHANCE_REPEATS) and noisy
        if name.startswith("tension"):
            flats, long = flats[y[flats[:, 0]] != 0.0], long[y[long[:, 0]] != 0.0]  # a slack tendon reads zero
        inputs = _inputs(recording, name)
        std = inputs.std(axis=0)
        frozen = tuple(
            _segment(recording, *flat)
            for flat in long
            if chance or _relative_motion(inputs[flat[0] : flat[1] - _DEAD_SAMPLES], std) > _MIN_MOTION
        )
        clipped = _find_clipping(recording, y, flats, quantum or 0.0, inputs, chance)
        # Unlike rates, tensions and velocities, positions have inertia and cannot jump for one sample.
        if name.removesuffix("_measured") in (*recording.robot.motor_positions, *recording.robot.outputs.names):
            outliers = _find_spikes(recording, y, quantum or 0.0, 0.0 if np.isnan(noise) else noise)
            if to_si(unit)[1] == "rad":
                parts = np.split(y, np.flatnonzero(np.diff(run)) + 1)
                wraps = sum(count_wraps(part, 2.0 * np.pi) for part in parts)
        edge = {(segment.start, segment.stop) for segment in clipped}
        frozen = tuple(segment for segment in frozen if (segment.start, segment.stop) not in edge)
    low, high = float(y[good].min()), float(y[good].max())
    return ChannelQuality(
        name, unit, y.size, low, high, missed, frozen, clipped, outliers, wraps, quantum, repeats, noise
    )


def is_command(name: str) -> bool:
    """Return whether a channel is a command and not a measurement."""
    return bool(_COMMAND_CHANNELS.fullmatch(name) or _COMMAND_CHANNELS.match(name))


def count_rows(segments: Iterable[Segment]) -> int:
    """Return the number of rows of all segments."""
    return sum(segment.rows for segment in segments)


def true_segments(mask: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Return (segments, 2) first row and row after the last of each segment of True, cut at the runs' borders."""
    inside = np.concatenate([[False], mask, [False]])
    border = np.concatenate([[True], run[1:] != run[:-1], [True]])
    starts = np.flatnonzero(inside[1:-1] & (~inside[:-2] | border[:-1]))
    stops = np.flatnonzero(inside[1:-1] & (~inside[2:] | border[1:])) + 1
    return np.column_stack([starts, stops])


def _segments_of(mask: np.ndarray, recording: Recording) -> tuple[Segment, ...]:
    return tuple(_segment(recording, *rows) for rows in true_segments(mask, recording.run))


def _segment(recording: Recording, start: int, stop: int) -> Segment:
    return Segment(int(start), int(stop), float(recording.time[start]), int(recording.run[start]))


def _find_flats(equal: np.ndarray) -> np.ndarray:
    """Return (flats, 2) rows of repeated values, the first value included."""
    inside = np.concatenate([[False], equal, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(inside))
    return np.column_stack([edges[::2] - 1, edges[1::2]])


def _inputs(recording: Recording, name: str) -> np.ndarray:
    """Return the inputs that drive a channel, (time, 1 or more): its motor, its output's direction, else all motors."""
    robot = recording.robot
    motors = range(1, len(robot.motors.names) + 1)
    for names in (robot.motor_positions, robot.motor_velocities, [f"tension_{j}" for j in motors]):
        if name in names:
            return recording.set_points[:, [names.index(name)]]
    weights, outputs = robot.weights(), robot.outputs.names
    of = next((i for i, output in enumerate(outputs) if name.startswith(output)), None)
    return recording.set_points if weights is None or of is None else recording.set_points @ weights[[of]].T


def _relative_motion(part: np.ndarray, std: Vector) -> float:
    """Return the motion of the inputs in a part, in standard deviations `std` of the whole record."""
    return float(np.max(np.divide(np.ptp(part, axis=0), std, out=np.zeros_like(std), where=std > 0)))


def _find_clipping(
    recording: Recording, y: Vector, flats: np.ndarray, quantum: float, inputs: np.ndarray, chance: bool
) -> tuple[Segment, ...]:
    """Return flat tops: values repeated at the edge of the range during motion, entered or left fast."""
    flats = flats[flats[:, 1] - flats[:, 0] >= CLIPPED_SAMPLES]
    if flats.size == 0:
        return ()
    steps = np.abs(np.diff(y))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    std = inputs.std(axis=0)
    # A natural turn is entered with steps of a quantum, a flat top at the speed of the motion.
    slope = max(2.0 * quantum, 0.25 * float(np.sqrt(np.mean(steps**2))))
    found = []
    for sign in (1.0, -1.0):
        z = sign * y
        top = z[flats[:, 0]].max()
        # Spikes may exceed the level at which the sensor saturates.
        if np.count_nonzero(z > top) > max(2, 1e-3 * y.size):
            continue
        for start, stop in flats[z[flats[:, 0]] == top]:
            fast = max(_speed(y, start, -1), _speed(y, stop - 1, 1)) > slope
            part = inputs[start : max(stop - _DEAD_SAMPLES, start + CLIPPED_SAMPLES)]
            enough = min(_MIN_MOTION_PER_SAMPLE * (stop - start), _MIN_MOTION_AT_TOP)
            if chance or (fast and _relative_motion(part, std) > enough):
                found.append(_segment(recording, start, stop))
    # A single short flat top is chance.
    chosen = tuple(sorted(found, key=lambda segment: segment.start))
    return chosen if len(chosen) > 1 or count_rows(chosen) > 7 else ()


def _speed(y: Vector, row: int, direction: int) -> float:
    """Return the mean step over the two samples before (-1) or after (1) a flat top."""
    other = row + 2 * direction
    if not 0 <= other < y.size or not np.isfinite(y[other]):
        return 0.0
    return abs(float(y[row] - y[other])) / 2.0


def _find_spikes(recording: Recording, y: Vector, quantum: float, noise: float) -> tuple[Segment, ...]:
    """Return spikes: large residuals of a running median of 5 (Hampel's identifier)."""
    spikes = np.zeros(y.size, dtype=bool)
    residual = np.zeros(y.size)
    for start, stop in true_segments(np.ones(y.size, dtype=bool), recording.run):
        rows = start + np.flatnonzero(np.isfinite(y[start:stop]))
        if rows.size >= _SPIKE_WINDOW:
            padded = np.pad(y[rows], _SPIKE_WINDOW // 2, mode="edge")
            residual[rows] = y[rows] - np.median(sliding_window_view(padded, _SPIKE_WINDOW), axis=1)
    size = np.abs(residual)
    floor = max(_SPIKE_FLOOR * (np.nanpercentile(y, 99) - np.nanpercentile(y, 1)), 4.0 * quantum)
    # Most samples of a smooth channel pass the filter unchanged, so the noise may be the larger scale.
    whole = max(_MAD_TO_STD * float(np.median(size[np.isfinite(y)])), 2.0 / 3.0 * noise)
    candidates = size > max(floor, _SPIKE_LIMIT * whole)
    for start, stop in true_segments(candidates, recording.run):
        near = np.concatenate([size[max(0, start - 12) : max(0, start - 2)], size[stop + 2 : stop + 12]])
        # While the platform shakes every other sample has a large residual, and none is a spike.
        if near.size == 0 or np.percentile(near, 75) < 0.25 * size[start:stop].max():
            rows = _spike(y, recording.run, start, stop)
            spikes[rows] = True
    return _segments_of(spikes, recording)


def _spike(y: Vector, run: np.ndarray, start: int, stop: int) -> slice:
    """Return the one or two rows from start to stop that differ most from both sides; an empty slice without any.

    The median filter also changes a good sample beside a spike on a fast move, so there may be more than two rows.
    A step and a real peak have a large difference beside them, a spike has none.
    """
    best, height = slice(0, 0), 0.0
    if stop - start > _SPIKE_WINDOW:
        return best
    for a in range(start, stop):
        for b in range(a + 1, min(a + 3, stop + 1)):
            # Three on either side: a sensor slower than the log repeats each value.
            beside = (a - 3, a - 2, a - 1, b, b + 1, b + 2)
            around = np.array([y[k] if 0 <= k < y.size and run[k] == run[a] else np.nan for k in beside])
            line = np.interp(np.arange(a, b), [a - 1, b], around[2:4])
            above = y[a:b] - line
            high = float(np.abs(above).min())
            same_side = bool((above > 0).all() or (above < 0).all())
            flank = np.nanmax(np.abs(around - around[[2, 2, 2, 2, 3, 3]]), initial=0.0)
            if np.isfinite(around[2:4]).all() and same_side and flank < 0.35 * high and high > height:
                best, height = slice(a, b), high
    return best


def _quantum(values: Vector) -> float | None:
    """Return the step whose multiples are the distances between levels; None if there is none."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    span = float(levels[-1] - levels[0])
    gaps = gaps[gaps > 1e-9 * span]  # smaller gaps come from rounding by unit factors
    if gaps.size < 2:
        return None
    small = gaps[gaps < 1.5 * gaps.min()]
    step = float(np.median(small))
    near = gaps[gaps < 20.5 * step] / step
    on_grid = np.abs(near - np.round(near)) < 0.1
    # By chance a fifth of the gaps would be this near to a multiple, and few gaps as small as the smallest.
    return step if on_grid.mean() > 0.95 and small.size > 0.1 * gaps.size else None


def recorded_noise(recordings: Sequence[Recording]) -> float:
    """Return the largest standard deviation of white noise on an output of recordings [SI], positive."""
    levels = []
    for recording in recordings:
        for name in recording.robot.outputs.names:
            channel = check_channel(recording, name)
            # A coarse sensor is as uncertain as its steps are wide, a clean one at least as a tenth of a percent.
            steps = (channel.quantum or 0.0) / math.sqrt(12.0)
            noise = 0.0 if math.isnan(channel.noise) else channel.noise
            levels.append(max(noise, steps) or _LEAST_NOISE_RATIO * (channel.highest - channel.lowest))
    return max(levels)


def _noise(y: Vector, run: np.ndarray) -> tuple[float, bool]:
    """Return the standard deviation of the noise, and whether it is noise: fourth differences change sign often.

    Fourth differences damp motion at 4 rad/s by (4 * 0.02)^4 = 4e-5 and amplify white noise by sqrt(70). Their
    neighbours correlate by -0.8: noise changes sign in 80 % of the samples, a smooth signal rarely.
    """
    fourth = np.diff(y, 4)
    inside = (run[4:] == run[:-4]) & np.isfinite(fourth) if fourth.size else np.zeros(0, dtype=bool)
    d = fourth[inside]
    if d.size < 8:
        return float("nan"), False
    std = _MAD_TO_STD * float(np.median(np.abs(d))) / float(np.sqrt(_FOURTH_DIFFERENCE_VARIANCE))
    moving = d[d != 0]
    alternates = bool(moving.size > 8 and np.mean(moving[1:] * moving[:-1] < 0) > 0.5)
    # The last bound is what double precision leaves of a smooth signal.
    return std, alternates and bool(std > 1e-9 * (np.nanmax(y) - np.nanmin(y)))
