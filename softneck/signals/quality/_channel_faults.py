"""What may be wrong with one channel: missed, frozen and clipped samples, spikes, coarse steps, noise."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from softneck.core import Vector, to_si
from softneck.robot import Robot

from ..recording._channels import file_unit
from ..recording._recording import Recording

# "Frozen" is what a deployment takes for it as well: 20 identical samples (hardware facts, table of faults).
FROZEN_SAMPLES = 20
# Fewer equal values at the edge of a channel happen by chance or at a slow turn.
CLIPPED_SAMPLES = 3
# A channel that repeats its last value more rarely than this never does so by chance for long.
_RARELY = 0.05
# An input moved if it did so by this part of its standard deviation: while a channel was frozen; for each sample of
# a flat top, and in all (a set-point that moves less is lost in a drive's friction, as neck_openloop shows).
_MOVED, _MOVED_PER_SAMPLE, _MOVED_AT_TOP = 0.25, 0.01, 0.05
# What an input did in the last 0.2 s of a stretch does not show yet: 0.08 s of dead time, and motion starts slowly.
_DEAD_SAMPLES = 10
# Half-width of the median filter that removes spikes of one or two samples and keeps steps and ramps.
_SPIKE_WINDOW = 5
# In standard deviations of what the median filter removes elsewhere; Gaussian noise reaches 6 once in 5e8 samples.
_SPIKE_LIMIT = 9.0
# Part of the channel's range below which a spike is of no consequence.
_SPIKE_FLOOR = 0.02
_MAD_TO_STD = 1.4826
# Fourth differences of white noise: variance 1 + 16 + 36 + 16 + 1.
_FOURTH = 70.0
# These say what was asked for; a held or a repeated value is no fault of a sensor.
_COMMANDS = re.compile(
    r"motor_setpoint_|.*_(setpoint|reference)$|payload|push_|base_tilt_|healthy|enabled|measurement_valid"
)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Rows start to stop (not included) of one run, from `time` [s] on."""

    start: int
    stop: int
    time: float
    run: int

    @property
    def rows(self) -> int:
        """Return how many rows it has."""
        return self.stop - self.start

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON holds."""
        return {"start_row": self.start, "rows": self.rows, "time_s": self.time, "run": self.run}


@dataclass(frozen=True, slots=True)
class ChannelQuality:
    """One channel; values in SI.

    Attributes:
        name: of the channel.
        unit: in files, which is the one for people.
        rows: samples, missed ones included.
        lowest, highest: of the finite samples; NaN where there are none.
        missed: stretches without a sample.
        frozen: stretches of at least 20 equal values where it should have moved.
        clipped: flat tops at the channel's highest or lowest value.
        outliers: spikes of one or two samples.
        quantum: the step between its levels; None where it has none.
        repeats: share of samples that equal the one before.
        noise: standard deviation of its white noise, from fourth differences; NaN where too short.
    """

    name: str
    unit: str
    rows: int
    lowest: float
    highest: float
    missed: tuple[Stretch, ...]
    frozen: tuple[Stretch, ...]
    clipped: tuple[Stretch, ...]
    outliers: tuple[Stretch, ...]
    quantum: float | None
    repeats: float
    noise: float

    @property
    def missed_rows(self) -> int:
        """Return how many samples are missing."""
        return count_rows(self.missed)

    @property
    def levels(self) -> float | None:
        """Return how many quanta the range spans."""
        return None if self.quantum is None else (self.highest - self.lowest) / self.quantum

    @property
    def command(self) -> bool:
        """Return whether it is a set-point or another command, and not a measurement."""
        return is_command(self.name)

    def shown(self, value: float) -> float:
        """Return an SI value in the channel's unit in files."""
        return value / to_si(self.unit)[0]

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON holds, in the unit of files; at most 20 stretches of each sort."""
        quantum = None if self.quantum is None else self.shown(self.quantum)
        faults = {"missed": self.missed, "frozen": self.frozen, "clipped": self.clipped, "outliers": self.outliers}
        return {
            "unit": self.unit,
            "lowest": self.shown(self.lowest),
            "highest": self.shown(self.highest),
            "quantum": quantum,
            "levels": self.levels,
            "repeats": self.repeats,
            "noise_std": self.shown(self.noise),
            **{f"{sort}_rows": count_rows(found) for sort, found in faults.items()},
            **{sort: [stretch.as_dict() for stretch in found[:20]] for sort, found in faults.items()},
        }


def check_channel(recording: Recording, name: str) -> ChannelQuality:
    """Return what is wrong with channel `name`; never across the border of two runs."""
    y, run, unit = recording.channels[name], recording.run, file_unit(name, recording.robot)
    good = np.isfinite(y)
    missed = _where(~good, recording)
    if not good.any():
        nan = float("nan")
        return ChannelQuality(name, unit, y.size, nan, nan, missed, (), (), (), None, 0.0, nan)
    equal = np.concatenate([[False], (y[1:] == y[:-1]) & (run[1:] == run[:-1])])
    repeats = float(equal[good].mean())
    quantum, (noise, noisy) = _quantum(y[good]), _noise(y, run)
    frozen: tuple[Stretch, ...] = ()
    clipped: tuple[Stretch, ...] = ()
    outliers: tuple[Stretch, ...] = ()
    if is_command(name):
        quantum = None
    elif y[good].min() < y[good].max():
        flats = _flats(equal)
        long = flats[flats[:, 1] - flats[:, 0] >= FROZEN_SAMPLES]
        # How often values repeat by chance is judged without frozen stretches and without the channel's edges.
        outside = equal & (y != y[good].max()) & (y != y[good].min())
        for start, stop in long:
            outside[start:stop] = False
        # What measures an output is never still; a drive, a tension or a length may be.
        noisy = noisy and noise > 2.0 * (quantum or 0.0) and name.startswith(recording.robot.outputs.names)
        chance = bool(outside.mean() < _RARELY) and noisy
        if name.startswith("tension"):
            flats, long = flats[y[flats[:, 0]] != 0.0], long[y[long[:, 0]] != 0.0]  # a slack tendon rests at zero
        inputs = _inputs(recording, name)
        std = inputs.std(axis=0)
        frozen = tuple(
            _stretch(recording, *flat)
            for flat in long
            if chance or _moved(inputs[flat[0] : flat[1] - _DEAD_SAMPLES], std) > _MOVED
        )
        clipped = _clipped(recording, y, flats, quantum or 0.0, inputs, chance)
        if name in _smooth(recording.robot):
            outliers = _outliers(recording, y, quantum or 0.0, 0.0 if np.isnan(noise) else noise)
        edge = {(stretch.start, stretch.stop) for stretch in clipped}
        frozen = tuple(stretch for stretch in frozen if (stretch.start, stretch.stop) not in edge)
    low, high = float(y[good].min()), float(y[good].max())
    return ChannelQuality(name, unit, y.size, low, high, missed, frozen, clipped, outliers, quantum, repeats, noise)


def _smooth(robot: Robot) -> set[str]:
    """Return the channels that have mass and cannot peak for one sample; a rate, a tension or a velocity can."""
    return {*robot.motor_positions, *robot.outputs.names, *(f"{name}_measured" for name in robot.outputs.names)}


def is_command(name: str) -> bool:
    """Return whether a channel says what was asked for, not what was measured."""
    return bool(_COMMANDS.fullmatch(name) or _COMMANDS.match(name))


def count_rows(stretches: Iterable[Stretch]) -> int:
    """Return the rows of all stretches."""
    return sum(stretch.rows for stretch in stretches)


def true_stretches(mask: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Return (stretches, 2) first row and row after the last of each stretch of True, cut at the runs' borders."""
    inside = np.concatenate([[False], mask, [False]])
    border = np.concatenate([[True], run[1:] != run[:-1], [True]])
    starts = np.flatnonzero(inside[1:-1] & (~inside[:-2] | border[:-1]))
    stops = np.flatnonzero(inside[1:-1] & (~inside[2:] | border[1:])) + 1
    return np.column_stack([starts, stops])


def _where(mask: np.ndarray, recording: Recording) -> tuple[Stretch, ...]:
    return tuple(_stretch(recording, *rows) for rows in true_stretches(mask, recording.run))


def _stretch(recording: Recording, start: int, stop: int) -> Stretch:
    return Stretch(int(start), int(stop), float(recording.time[start]), int(recording.run[start]))


def _flats(equal: np.ndarray) -> np.ndarray:
    """Return (flats, 2) rows of values that are repeated, the first of each included."""
    inside = np.concatenate([[False], equal, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(inside))
    return np.column_stack([edges[::2] - 1, edges[1::2]])


def _inputs(recording: Recording, name: str) -> np.ndarray:
    """Return what drives a channel, (time, 1 or more): its motor, its output's direction, else all of them."""
    robot = recording.robot
    motors = range(1, len(robot.motors.names) + 1)
    for names in (robot.motor_positions, robot.motor_velocities, [f"tension_{j}" for j in motors]):
        if name in names:
            return recording.set_points[:, [names.index(name)]]
    weights, outputs = robot.weights(), robot.outputs.names
    of = next((i for i, output in enumerate(outputs) if name.startswith(output)), None)
    return recording.set_points if weights is None or of is None else recording.set_points @ weights[[of]].T


def _moved(part: np.ndarray, std: Vector) -> float:
    """Return by how many standard deviations `std` of the whole record the inputs moved in a part of it."""
    return float(np.max(np.divide(np.ptp(part, axis=0), std, out=np.zeros_like(std), where=std > 0)))


def _clipped(
    recording: Recording, y: Vector, flats: np.ndarray, quantum: float, inputs: np.ndarray, chance: bool
) -> tuple[Stretch, ...]:
    """Return flat tops: values repeated at the edge of the range that were neither reached slowly nor held there."""
    flats = flats[flats[:, 1] - flats[:, 0] >= CLIPPED_SAMPLES]
    if flats.size == 0:
        return ()
    steps = np.abs(np.diff(y))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    std = inputs.std(axis=0)
    # A natural turn is entered with steps of a quantum at most, a flat top with the speed of the motion.
    slope = max(2.0 * quantum, 0.25 * float(np.sqrt(np.mean(steps**2))))
    found = []
    for sign in (1.0, -1.0):
        z = sign * y
        top = z[flats[:, 0]].max()
        # Spikes may lie beyond the level at which the sensor saturates.
        if np.count_nonzero(z > top) > max(2, 1e-3 * y.size):
            continue
        for start, stop in flats[z[flats[:, 0]] == top]:
            fast = max(_speed(y, start, -1), _speed(y, stop - 1, 1)) > slope
            seen = inputs[start : max(stop - _DEAD_SAMPLES, start + CLIPPED_SAMPLES)]
            enough = min(_MOVED_PER_SAMPLE * (stop - start), _MOVED_AT_TOP)
            if chance or (fast and _moved(seen, std) > enough):
                found.append(_stretch(recording, start, stop))
    # One short flat top alone is chance.
    chosen = tuple(sorted(found, key=lambda stretch: stretch.start))
    return chosen if len(chosen) > 1 or count_rows(chosen) > 7 else ()


def _speed(y: Vector, row: int, direction: int) -> float:
    """Return the mean step of the two samples before (-1) or after (1) a flat top."""
    other = row + 2 * direction
    if not 0 <= other < y.size or not np.isfinite(y[other]):
        return 0.0
    return abs(float(y[row] - y[other])) / 2.0


def _outliers(recording: Recording, y: Vector, quantum: float, noise: float) -> tuple[Stretch, ...]:
    """Return spikes: what a running median of 5 removes, against its robust scale (Hampel's identifier)."""
    spikes = np.zeros(y.size, dtype=bool)
    residual = np.zeros(y.size)
    for start, stop in true_stretches(np.ones(y.size, dtype=bool), recording.run):
        rows = start + np.flatnonzero(np.isfinite(y[start:stop]))
        if rows.size >= _SPIKE_WINDOW:
            padded = np.pad(y[rows], _SPIKE_WINDOW // 2, mode="edge")
            residual[rows] = y[rows] - np.median(sliding_window_view(padded, _SPIKE_WINDOW), axis=1)
    size = np.abs(residual)
    floor = max(_SPIKE_FLOOR * (np.nanpercentile(y, 99) - np.nanpercentile(y, 1)), 4.0 * quantum)
    # Most samples of a smooth channel pass the filter unchanged: its noise is the better scale there.
    whole = max(_MAD_TO_STD * float(np.median(size[np.isfinite(y)])), 2.0 / 3.0 * noise)
    candidates = size > max(floor, _SPIKE_LIMIT * whole)
    for start, stop in true_stretches(candidates, recording.run):
        near = np.concatenate([size[max(0, start - 12) : max(0, start - 2)], size[stop + 2 : stop + 12]])
        # Where the platform shakes, every other sample has a large residual, and none is a spike.
        if near.size == 0 or np.percentile(near, 75) < 0.25 * size[start:stop].max():
            rows = _spike(y, recording.run, start, stop)
            spikes[rows] = True
    return _where(spikes, recording)


def _spike(y: Vector, run: np.ndarray, start: int, stop: int) -> slice:
    """Return the one or two rows from start to stop that stand out most from both sides; none where none do.

    Beside a spike on a fast move the median filter changes a good sample too, so that the rows may be more than two.
    A step does not come back, and a real peak has a flank: both have a large difference beside the spike.
    """
    best, height = slice(0, 0), 0.0
    if stop - start > _SPIKE_WINDOW:
        return best
    for a in range(start, stop):
        for b in range(a + 1, min(a + 3, stop + 1)):
            # Three to either side: a sensor slower than the log shows each of its values twice.
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
    """Return the step of which all distances between levels are multiples; None where there is no such step."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    span = float(levels[-1] - levels[0])
    gaps = gaps[gaps > 1e-9 * span]  # below: rounding of one level by unit factors
    if gaps.size < 2:
        return None
    small = gaps[gaps < 1.5 * gaps.min()]
    step = float(np.median(small))
    near = gaps[gaps < 20.5 * step] / step
    on_grid = np.abs(near - np.round(near)) < 0.1
    # By chance a fifth of the gaps would lie so near to a multiple, and few gaps be as small as the smallest.
    return step if on_grid.mean() > 0.95 and small.size > 0.1 * gaps.size else None


def _noise(y: Vector, run: np.ndarray) -> tuple[float, bool]:
    """Return the noise's standard deviation and whether it is noise: fourth differences that keep changing sign.

    Fourth differences suppress motion at 4 rad/s by (4 * 0.02)^4 = 4e-5 and amplify white noise by sqrt(70), and
    their neighbours correlate by -0.8, so that the sign changes in 80 % of the samples; a smooth signal's seldom does.
    """
    fourth = np.diff(y, 4)
    inside = (run[4:] == run[:-4]) & np.isfinite(fourth) if fourth.size else np.zeros(0, dtype=bool)
    d = fourth[inside]
    if d.size < 8:
        return float("nan"), False
    std = _MAD_TO_STD * float(np.median(np.abs(d))) / float(np.sqrt(_FOURTH))
    moving = d[d != 0]
    alternates = bool(moving.size > 8 and np.mean(moving[1:] * moving[:-1] < 0) > 0.5)
    # Beyond what double precision leaves of a smooth signal.
    return std, alternates and bool(std > 1e-9 * (np.nanmax(y) - np.nanmin(y)))
